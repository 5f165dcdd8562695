"""Bounds that outputs may leave in a share of the steps: quantiles of a log's errors."""

from typing import Any

import numpy as np
import pytest

import torch_qpmpc as qm
from tests.benchmarks.violation import identified, rate
from tests.refused import refused

OPTIONS: dict[str, Any] = {"Q": 1.0, "dR": 0.1, "u_bounds": (0.0, 10.0), "y_bounds": (2.0, 6.0)}


@pytest.fixture(scope="module")
def model():
    return identified("heavy-tailed", 0)


def made(model, violation: Any = None, **options: Any) -> qm.Controller:
    return qm.Controller(qm.LinearMPC(model, 12, **{**OPTIONS, **options}, violation=violation))


def test_plans_stay_away_by_the_order_statistic_of_the_second_step_s_errors(model):
    """The input acts on the second step: through a lag that the output follows."""
    design = made(model, {"T": 0.1}).mpc.design
    errors = np.sort(model.errors[:, 1, 0].numpy())
    errors = errors[np.isfinite(errors)]
    place = int(np.ceil(0.9 * (len(errors) + 1))) - 1
    assert np.allclose(design.margins[:, 0], [-errors[-place - 1], errors[place]])
    assert (errors > design.margins[1]).mean() <= 0.1
    target = made(model, {"T": 0.1}).mpc.target([[9.0], [-3.0]]).y[:, 0].numpy()
    assert np.allclose(target, [6 - design.margins[1, 0], 2 + design.margins[0, 0]], atol=1e-6)


def test_a_share_of_unseen_steps_keeps_the_bound(model):
    """Without a margin a third of them leaves it."""
    assert rate(made(model), "heavy-tailed", 0, 400)[0] > 0.15
    assert rate(made(model, 0.05), "heavy-tailed", 0, 400)[0] <= 0.05


def test_a_redesign_a_file_and_the_review_know_it(model, tmp_path):
    controller = made(model, 0.2)
    before = controller.mpc.design.margins[1, 0]
    controller.redesign(violation={"T": 0.02})
    after = controller.mpc.design.margins[1, 0]
    assert after > 2 * before
    text = controller.review()["violation"].text
    assert text.startswith("T leaves each bound in at most 0.02 of the steps if errors are like")
    assert f"{after:.4g} away, as predictions of step 2, the first that an input decides" in text
    remedy = controller.review(r=[8.0])["set-points"].remedy
    assert remedy == f"Set T to {6 - after:.5g}, not 8, or widen y_bounds of T."
    controller.reset(y=[5.0], u=[5.0])
    controller.step([5.9], [9.0])
    assert f"T is at its upper bound {6 - after:.4g} " in str(controller.explain())
    controller.save(tmp_path / "tank.qpmpc")
    loaded = qm.Controller.load(tmp_path / "tank.qpmpc")
    assert loaded.mpc.design.margins[1, 0] == after
    loaded.redesign(violation={"T": None})
    assert not loaded.mpc.design.margins.any()


@refused(
    (1.5, {}, "violation: got 1.5 of T, expected a share in"),
    (0.1, {"y_bounds": None}, "violation: got 0.1 of T, expected a share .* with y_bounds, or No"),
    (
        1e-4,
        {},
        r"violation: got 0.0001 of T, and \d+ errors .* 2 steps ahead, expected 9999 errors",
    ),
    (0.1, {"y_bounds": (5.9, 6.0)}, "violation: got {'T': 0.1}, which leaves no room between"),
    ({"q": 0.1}, {}, "violation: got 'q', expected names among T"),
)
def test_what_the_log_cannot_promise_is_refused(share, options, model):
    made(model, share, **options)


@refused((0.1, r".* and 0 errors .* Pass a model of qm.identify\(.., horizon=1"))
def test_a_model_without_a_log_promises_nothing(share):
    made(([[0.9]], [[0.5]]), share)


def test_c_keeps_the_same_distance(model, tmp_path):
    controller = made(model, 0.05)
    difference = controller.export_c(tmp_path).difference
    assert difference < 1e-8
