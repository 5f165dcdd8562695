"""A tally sums over the run, counts QPs per row, and is restored from a checkpoint."""

import itertools
from types import SimpleNamespace

import pytest
import torch
from numba.core import event
from tensordict import TensorDict

from tests.problems import random_mpc, random_states
from torch_qpmpc.experiment import metrics as module
from torch_qpmpc.experiment.metrics import Tally

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
