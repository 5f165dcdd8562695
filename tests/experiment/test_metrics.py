"""The numbers that a run logs, and its summary."""

import itertools
import math
from types import SimpleNamespace

import pandas as pd
import pytest
import torch
from numba.core import event
from tensordict import TensorDict

from tests.problems import random_mpc, random_states
from tests.runs import SMALL, linear_system, make_config
from torch_qpmpc.analysis.report import structure_metrics
from torch_qpmpc.envs.closed_loop import ClosedLoop
from torch_qpmpc.experiment import metrics as module
from torch_qpmpc.experiment.evaluation import Evaluation, closed_gap
from torch_qpmpc.experiment.metrics import Tally, report, table, theta_metrics
from torch_qpmpc.experiment.run_folder import RunFolder
from torch_qpmpc.experiment.tasks import make_mpc, make_physics


def evaluation(start: float, learned: float, true: float, **rivals: float) -> Evaluation:
    """Make an evaluation of two steps from two starts with total cost J, discounted by 0.9."""

    def loop(J: float) -> ClosedLoop:
        costs = torch.full((2, 2), J / 2, dtype=torch.float64)
        ended, failed = torch.full((2,), 2.0), torch.zeros(2, dtype=torch.bool)
        return ClosedLoop(torch.zeros(3, 2, 4), torch.zeros(2, 2, 2), costs, 4, ended, failed)

    cfg, loops = make_config(), {"start": start, "learned": learned, "true model": true}
    return Evaluation(cfg, make_physics(cfg), {name: loop(J) for name, J in loops.items()}, rivals)


def test_closed_gap():
    assert closed_gap(100, 100, 50) == 0
    assert closed_gap(100, 50, 50) == 1
    assert closed_gap(100, 75, 50) == 0.5
    assert closed_gap(100, 125, 50) == -0.5
    assert all(map(math.isnan, (closed_gap(50, 40, 50), closed_gap(40, 40, 50))))
    assert math.isnan(closed_gap(math.nan, 1, 0))


def test_table():
    lines = table(evaluation(100, 60, 50).summary()).splitlines()
    assert lines[0].split() == ["start", "learned", "true", "model", "closed", "gap"]
    assert lines[1].split() == ["J", "100.0", "60.00", "50.00", "0.800"]
    assert lines[2].split() == ["J", "discounted", "95.00", "57.00", "47.50", "0.800"]
    assert lines[3:] == ["Mean cost of 2 episodes of at most 2 steps"]


def test_the_numbers_of_theta_are_logged_where_they_are_few():
    cfg = make_config("task=gros_zanon", "constraint=mpc", "task.learn_cost=[q,c]")
    metrics = theta_metrics(make_mpc(cfg, make_physics(cfg)))
    expected = {"theta/c": 0.0, "theta/A_1": 0.25, "theta/B_0": 0.0312, "theta/ub_0": 2.0}
    assert {name: metrics[name] for name in expected} == pytest.approx(expected)
    parts = {"A": 4, "B": 2, "b": 2, "q": 5, "lb": 3, "ub": 3}
    names = {f"theta/{part}_{i}" for part, count in parts.items() for i in range(count)}
    assert set(metrics) == names | {"theta/c"}
    free = make_config("constraint=free")
    names = {f"theta/H_{i}" for i in range(6)} | {"theta/c"}
    assert set(theta_metrics(make_mpc(free, make_physics(free)))) == names


def test_report_logs_the_evaluation(tmp_path):
    cfg = make_config(*SMALL, "constraint=free")
    physics = linear_system(cfg)
    mpc = make_mpc(cfg, physics)
    with torch.no_grad():
        mpc.C[0, -1] += 0.5
    found = Evaluation.before(cfg, physics, mpc)
    found.rivals["Kalman filter, N = 60"] = 5.0
    with RunFolder(tmp_path, cfg) as run:
        summary = report(run, mpc, found, 20)
    assert summary == found.summary()
    loop, truth = found.loops["learned"], found.loops["true model"]
    (row,) = pd.read_csv(tmp_path / "metrics.csv").to_dict("records")
    expected = {"update": 20, "eval/J": loop.J, "eval/J_true_model": truth.J}
    expected |= {"eval/J_discounted": loop.discounted(0.9), "eval/J_Kalman_filter_N_60": 5.0}
    expected |= {"eval/closed_gap": summary["closed_gap"]}
    expected |= {"structure/on": 0, "structure/above": 0.5, "structure/below": 0}
    expected |= {f"structure/{name}": value for name, value in structure_metrics(mpc).items()}
    assert row["structure/causality_defect"] > 0.01
    assert row == pytest.approx(expected, nan_ok=True)


# --- Tally ---------------------------------------------------------------------------------------

MOVED = {"train/accepted": torch.ones(())}


def batch(reward: float) -> TensorDict:
    return TensorDict({"next": {"reward": torch.full((3, 2, 1), reward)}}, batch_size=[3, 2])


def test_costs_are_averaged():
    tally = Tally()
    for update in range(1, 21):
        tally.add(batch(-float(update)), {"train/accepted": torch.tensor(update % 2)})
    assert (tally.update, tally.summary()["accepted_updates"]) == (20, 10)
    assert tally.metrics()["train/reward"] == -20
    summary = tally.summary()
    assert (summary["train_cost"], summary["train_cost_last_tenth"]) == (10.5, 19.5)


def test_a_row_has_the_qps_since_the_one_before():
    tally, mpc = Tally(), random_mpc(3, on_failure="mask")
    for count in (4, 2):
        with tally.timed():
            mpc.value(random_states(count))
        tally.add(batch(0.0), MOVED)
        tally.qps.unsolved += 1
        row = tally.metrics()
        assert (row["qp/solves"], row["qp/unsolved"]) == (count, 1)
    mpc.value(random_states(3))
    assert (tally.qps.solves, tally.summary()["unsolved"]) == (0, 2)


def test_seconds_are_split_and_leave_compilation_out(monkeypatch: pytest.MonkeyPatch):
    clock, compiler = itertools.count(step=1.0), itertools.count(step=0.25)
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    monkeypatch.setattr(event, "timer", lambda: next(compiler))
    tally = Tally()
    with tally.timed() as times:
        times.append(module.time.perf_counter())
        with event.trigger_event("numba:compile", {"dispatcher": SimpleNamespace(py_func=batch)}):
            pass
    assert times == [0, 1, 2]
    assert tally.seconds == 2 - 0.25
