"""Ctrl-C and SIGTERM stop a run between updates with a checkpoint; a second one acts at once."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import train
from tests.runs import SMALL, make_config
from tests.stops import assert_events_are_whole, assert_same_numbers, go_on
from torch_qpmpc.experiment import evaluation
from torch_qpmpc.experiment.checkpoint import load_checkpoint
from torch_qpmpc.experiment.interrupt import Interrupt
from torch_qpmpc.learning.replay import Replay
from torch_qpmpc.qp.pipeline.solve import SolveLog

SIGNALS = (signal.SIGINT, signal.SIGTERM)
RUN = (*SMALL, "updates=5", "eval_interval=3", "task.eval_steps=5")


@pytest.fixture(autouse=True)
def listening() -> Iterator[None]:
    """Restore Ctrl-C's default handler, which a shell's background jobs and children lack."""
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, usual)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finish a run without a signal."""
    folder = tmp_path_factory.mktemp("whole")
    train.train(make_config(*RUN), str(folder), quiet=True)
    return folder


@pytest.mark.parametrize("signum", SIGNALS)
def test_the_first_signal_is_noted_and_the_second_acts(signum):
    before = signal.getsignal(signum)
    acted = []
    signal.signal(signum, lambda *_: acted.append(signum))
    try:
        with Interrupt() as interrupt:
            signal.raise_signal(signum)
            assert (interrupt.signum, acted) == (signum, [])
            signal.raise_signal(signum)
            assert acted == [signum]
        signal.raise_signal(signum)
        assert acted == [signum, signum]
    finally:
        signal.signal(signum, before)


def test_a_block_without_a_signal_changes_nothing(capsys):
    before = [signal.getsignal(signum) for signum in SIGNALS]
    with Interrupt() as interrupt:
        interrupt.exit_if_signalled("never said")
    assert interrupt.signum is None
    assert [signal.getsignal(signum) for signum in SIGNALS] == before
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("where", "call", "signum", "said"),
    [
        ("train.make_physics", 1, signal.SIGTERM, "before the first update"),
        ("evaluation.evaluate", 1, signal.SIGINT, "before the first update"),
        ("train.report", 1, signal.SIGTERM, "before the first update"),
        ("torch_qpmpc.learning.replay.Replay.extend", 1, signal.SIGINT, "before the first update"),
        ("torch_qpmpc.learning.replay.Replay.extend", 4 + 2, signal.SIGTERM, "after update 2"),
        ("evaluation.evaluate", 3, signal.SIGINT, "after update 3"),
        ("train.save_checkpoint", 1, signal.SIGTERM, "after update 3"),
    ],
)
def test_a_run_stops_cleanly_wherever_the_signal_comes(
    tmp_path, monkeypatch, capsys, whole, where, call, signum, said
):
    """The signal arrives at start, or while warming up, learning, evaluating or saving."""
    cfg, folder, calls = make_config(*RUN), tmp_path / "run", []
    with monkeypatch.context() as patch:
        signal_at(patch, where, call, signum, calls)
        with pytest.raises(SystemExit) as ended:
            train.train(cfg, str(folder))
    assert ended.value.code == 128 + signum
    sentence = f"Stopped {said}: python train.py resume={folder}"
    assert capsys.readouterr().out.splitlines()[-1] == sentence
    assert (folder / "checkpoint.pt").exists() == ("after" in said)
    go_on(folder)
    assert_same_numbers(folder, whole)
    assert_events_are_whole(folder)


def signal_at(patch: pytest.MonkeyPatch, where: str, call: int, signum: int, calls: list) -> None:
    """Send ``signum`` in the given call of the function named ``where``."""
    name = where.rpartition(".")[2]
    modules = {"train": train, "evaluation": evaluation}
    module: Any = modules.get(where.rpartition(".")[0], Replay)
    function = getattr(module, name)

    def signalled(*args: Any, **named: Any) -> Any:
        calls.append(name)
        if len(calls) == call:
            signal.raise_signal(signum)
        return function(*args, **named)

    patch.setattr(module, name, signalled)


def test_a_signal_in_the_last_update_lets_the_run_finish(tmp_path, monkeypatch):
    signal_at(monkeypatch, "train.save_checkpoint", 2, signal.SIGTERM, [])
    assert train.train(make_config(*RUN), str(tmp_path))["updates"] == 5
    assert (tmp_path / "summary.json").exists()


def test_a_second_ctrl_c_keeps_the_log_and_the_last_checkpoint(tmp_path, monkeypatch):
    entered, enter = [], SolveLog.__enter__

    def twice(log: SolveLog) -> SolveLog:
        entered.append(log)
        if len(entered) == 5:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        return enter(log)

    monkeypatch.setattr(SolveLog, "__enter__", twice)
    with pytest.raises(KeyboardInterrupt):
        train.train(make_config(*RUN), str(tmp_path))
    assert load_checkpoint(tmp_path / "checkpoint.pt")["update"] == 3
    assert_events_are_whole(tmp_path)


def test_one_run_of_a_sweep_leaves_signals_to_its_launcher(tmp_path, monkeypatch):
    signal_at(monkeypatch, "evaluation.evaluate", 1, signal.SIGINT, [])
    with pytest.raises(KeyboardInterrupt):
        train.train(make_config(*RUN), str(tmp_path / "run"), quiet=True)
    assert not Path(tmp_path / "run").exists()
