from __future__ import annotations

import copy

import pytest
import torch
from torch.testing import assert_close

from tests.problems import normal, random_mpc
from tests.test_warm_start import transitions
from torch_qpmpc import (
    DeviationPenalty,
    GaussNewton,
    QPActorValueOperator,
    QPQLearningLoss,
    SystemIdentificationPenalty,
)
from torch_qpmpc.replay import ACTIVE_SET
from torch_qpmpc.updates import first_order, second_order


def make_loss(mpc, key: str | None = None, **options) -> QPQLearningLoss:
    loss = QPQLearningLoss(QPActorValueOperator(mpc, active_set_key=key), **options)
    loss.make_value_estimator(gamma=0.9)
    return loss


def test_the_first_order_descends_the_sum_of_its_terms():
    mpc = random_mpc(3)
    twin, loss = copy.deepcopy(mpc), make_loss(mpc)
    deviation = DeviationPenalty(mpc.C_0, mpc.n_x, mpc.n_u)
    si, windows = SystemIdentificationPenalty(1e-2), normal(5, mpc.n_z)
    update = first_order(mpc, loss, torch.optim.SGD(mpc.parameters(), lr=1e-3), deviation, si)
    terms, scalars = update(transitions(), windows)
    assert set(terms) == {"loss/value", "loss/si", "loss/deviation"}
    assert scalars["unsolved"] == 0
    total = make_loss(twin)(transitions())["loss_value"] + si(twin.C, windows) + deviation(twin.C)
    total.backward()
    assert_close(sum(terms.values()), total)
    for moved, still in zip(mpc.parameters(), twin.parameters(), strict=True):
        assert still.grad is not None
        assert_close(moved.detach(), still.detach() - 1e-3 * still.grad)


@pytest.mark.parametrize("with_si", [False, True])
@pytest.mark.parametrize("clip", [None, 0.5])
def test_the_second_order_steps_towards_the_loss_modules_targets(with_si, clip):
    mpc = random_mpc(3)
    twin, loss = copy.deepcopy(mpc), make_loss(mpc, td_error_clip=clip)
    si, windows = SystemIdentificationPenalty(1e-2), normal(5, mpc.n_z)
    update = second_order(mpc, loss, GaussNewton(mpc, td_error_clip=clip), si if with_si else None)
    batch = transitions()
    terms, scalars = update(batch, windows if with_si else None)
    expected = make_loss(twin, td_error_clip=clip)(transitions())
    assert_close(terms["loss/value"], expected["loss_value"].detach())
    assert ("loss/si" in terms) == with_si
    for name in ("td_error", "pred_value", "target_value", "unsolved"):
        assert_close(scalars[name], expected[name])
    with torch.no_grad():
        target = make_loss(twin).target(transitions())
        s, a = batch["observation"], batch["action"]
        penalty = si.curvature(windows) if with_si else None
        GaussNewton(twin, td_error_clip=clip).step(s, a, -target, penalty=penalty)
    assert_close(mpc.state_dict(), twin.state_dict(), rtol=1e-9, atol=1e-12)


def test_the_second_order_keeps_active_sets():
    mpc = random_mpc(3)
    loss = make_loss(mpc, ACTIVE_SET)
    batch = transitions()
    expected = mpc.solve(batch["observation"], batch["action"]).active
    second_order(mpc, loss, GaussNewton(mpc), None)(batch, None)
    assert torch.equal(batch[ACTIVE_SET], expected)
    assert ACTIVE_SET in batch["next"]


def test_what_is_not_solved_is_counted():
    mpc = random_mpc(3, on_failure="mask")
    batch = transitions()
    batch["action"][2] = 9.0  # beyond a hard bound
    terms, scalars = second_order(mpc, make_loss(mpc), GaussNewton(mpc), None)(batch, None)
    assert scalars["unsolved"] == 1
    assert all(term.isfinite() for term in terms.values())
