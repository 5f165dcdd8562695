"""MPC with the model of a run's transitions and no learning, the rival of every task."""

import json
import math
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

import train
from tests.runs import SMALL, linear_system, make_config
from torch_qpmpc.experiment import evaluation
from torch_qpmpc.experiment.evaluation import Evaluation
from torch_qpmpc.experiment.rivals import IDENTIFICATION
from torch_qpmpc.experiment.start import collect_log, make_start, transitions
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.experiment.tasks.identified import identified_start, nominal_mpcs
from torch_qpmpc.identification.identification import identify
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.mpc.riccati import terminal_riccati
from torch_qpmpc.mpc.stage_cost import fit_rewards

DATA = ("start=data", "start.transitions=400", "solver=daqp")
#: Short episodes: without control the plant is unstable.
GROS_ZANON = ("task=gros_zanon", *DATA, "num_envs=20", "task.episode_steps=20")


def test_the_model_is_fitted_and_the_cost_is_the_plants_own():
    cfg = make_config(*GROS_ZANON)
    physics = linear_system(cfg)
    (mpc,) = nominal_mpcs(cfg, physics, [collect_log(cfg, physics)])
    A, B, offset = physics.true_model()
    for found, true in zip(mpc.model()[:2], (A, B), strict=True):
        assert_close(found, true, atol=0.02, rtol=0)
    assert_close(-mpc.b[:2], offset, atol=0.01, rtol=0)
    assert mpc.scheme.gamma == 1
    assert_close(mpc.scheme.cost.stage_weight, torch.tensor([1.0, 1.0, 0.5]).double())
    assert not mpc.learned


def test_its_bounds_hold_with_a_probability_of_95_percent():
    cfg = make_config(*GROS_ZANON)
    physics = linear_system(cfg)
    log = collect_log(cfg, physics)
    (mpc,) = nominal_mpcs(cfg, physics, [log])
    std = torch.tensor(identify(log, order=0).model.S[0, 0]).sqrt()
    assert std.item() == pytest.approx(0.1 / math.sqrt(12), rel=0.1)
    # Of x_0, which is known, and x_1; the rows are those of [x_k, u_k].
    assert_close(mpc.lb[0], physics.lb_s[0])
    assert_close(mpc.lb[3], physics.lb_s[0] + 1.645 * std, atol=1e-4, rtol=0)


def test_a_cost_that_the_task_lacks_is_fitted_to_the_rewards():
    W = "task.stage_weight=null"
    cfg = make_config("task=pendulum", W, *DATA, "constraint=free")
    physics = make_physics(cfg)
    log = collect_log(cfg, physics)
    mpc, regulated = nominal_mpcs(cfg, physics, [log])
    fitted = fit_rewards(log, mpc.scheme.layout)
    assert fitted.R2 > 0.5
    assert_close(mpc.scheme.cost.stage_weight, fitted.W)
    assert_close(mpc.H_f, fitted.W[:3, :3])
    A, B = regulated.model()
    assert_close(regulated.H_f, terminal_riccati(A, B, fitted.W, 1.0, mpc.scheme.layout))


def test_all_of_a_runs_transitions_are_used(tmp_path):
    cfg = make_config(*GROS_ZANON)
    physics = make_physics(cfg)
    log = collect_log(cfg, physics)
    replay = Replay(400, 20, 8, 5, 1)
    ids = log["next", "done"][..., 0].int()
    replay.extend(log.exclude("preview").set(("collector", "traj_ids"), ids))
    (stored,) = transitions(make_config("task=gros_zanon"), tmp_path, replay)
    assert_close(stored["observation"][:, -1], log["observation"][:, -1])
    make_start(cfg, physics, tmp_path)
    first, second = transitions(cfg, tmp_path, replay)
    assert torch.equal(first["action"], log["action"])
    assert second.shape == (20, 20)


@pytest.mark.parametrize(
    ("chosen", "there"), [("true", True), ("false", False), ("[identification]", True)]
)
def test_it_is_evaluated_if_it_is_chosen(chosen, there):
    cfg = make_config(*GROS_ZANON, f"rivals={chosen}", "task.eval_steps=20")
    physics = make_physics(cfg)
    found = Evaluation.before(cfg, physics, make_mpc(cfg, physics))
    assert IDENTIFICATION not in found.rivals
    log = collect_log(cfg, physics)
    found.identify(lambda: [log])
    assert (IDENTIFICATION in found.rivals) == there
    if there:
        assert found.rivals[IDENTIFICATION] < 0.8 * found.loops["start"].J
        assert not found.missing
        found.identify(lambda: [log[:2, :1]])
        assert math.isnan(found.rivals[IDENTIFICATION])
        assert "trajectories: got 2 transitions" in found.missing["rival identification"]


PENDULUM = ("task=gymnasium", "task.id=Pendulum-v1", *DATA, "constraint=free", "num_envs=2")


@pytest.mark.parametrize("order", [0, 3], ids=["outputs", "estimates"])
@pytest.mark.filterwarnings("ignore:The fitted stage cost")
def test_logs_of_any_kind_have_a_rival_or_a_reason(order):
    """Of estimates and of outputs, of few rows, and without an episode's end."""
    cfg = make_config(*PENDULUM, "rivals=[identification]", "task.eval_steps=2")
    physics = make_physics(cfg)
    log = collect_log(cfg, physics)
    start = identified_start(cfg, physics, log, order)
    assert ("next", "measured") in start.log.keys(True)
    found = Evaluation(cfg, physics.observed(start.observer), {}, {})
    flags = [("next", name) for name in ("done", "terminated", "truncated")]
    for rows in range(4):
        few = start.log[:, :rows].exclude(("next", "measured"))
        for data in ([few], [start.log, few], [few, start.log.exclude(*flags)]):
            found.missing.clear()
            found.identify(lambda data=data: data)
            reason = found.missing.get("rival identification", "trajectories: got 0")
            assert reason.startswith("trajectories: got "), reason
            missing = len(data) == 1 and few.numel() <= start.layout.n_x + 2
            assert bool(found.missing) == missing
            assert math.isfinite(found.rivals[IDENTIFICATION]) != missing


@pytest.mark.parametrize("costs", [[2.0, 1.0], [1.0, 2.0], [math.nan, 1.0]])
def test_the_better_scheme_counts(monkeypatch, costs):
    cfg = make_config(*GROS_ZANON)
    physics, left = make_physics(cfg), iter(costs)
    mpc = make_mpc(cfg, physics)
    monkeypatch.setattr(evaluation, "nominal_mpcs", lambda *_: [mpc, mpc])
    monkeypatch.setattr(evaluation, "evaluate", lambda *_: SimpleNamespace(J=next(left)))
    run = Evaluation(cfg, physics, {}, {})
    run.identify(list)
    assert run.rivals == {IDENTIFICATION: 1.0}


@pytest.mark.parametrize("replay", [True, False])
def test_a_run_ends_with_it(tmp_path, replay):
    names = f"rivals=[{IDENTIFICATION}]"
    cfg = make_config(*SMALL, "constraint=free", f"replay={str(replay).lower()}", names)
    summary = train.train(cfg, str(tmp_path), quiet=True)
    assert [*summary["rivals"]] == [IDENTIFICATION]
    assert json.loads((tmp_path / "summary.json").read_text())["rivals"] == summary["rivals"]
