"""Stopping and resuming runs, and comparing them with undisturbed ones."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import train
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.launch import settled
from torch_qpmpc.experiment.run_folder import read_config
from torch_qpmpc.qp.pipeline.solve import SolveLog


def stop(
    monkeypatch: pytest.MonkeyPatch,
    cfg: Config,
    folder: Path,
    update: int,
    signum: int = signal.SIGTERM,
) -> int:
    """Run or resume until ``update``, send a signal there, and return the exit code."""
    state = None
    if (folder / "config.yaml").exists():
        cfg, state = begun(folder)
    left = update - (state["update"] if state else 0)
    entered = []

    def count(log: SolveLog) -> SolveLog:
        entered.append(log)
        if len(entered) == left:
            signal.raise_signal(signum)
        return enter(log)

    enter = SolveLog.__enter__
    with monkeypatch.context() as patch:
        patch.setattr(SolveLog, "__enter__", count)
        with pytest.raises(SystemExit) as ended:
            train.train(cfg, str(folder), state)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def begun(folder: Path) -> tuple[Config, dict[str, Any] | None]:
    """Return the configuration and the state of a stopped run."""
    cfg = read_config(folder)
    state, summary = settled(cfg, folder, sweep=False)
    assert summary is None
    return cfg, state


def go_on(folder: Path) -> None:
    """Resume a stopped run and finish it."""
    cfg, state = begun(folder)
    train.train(cfg, str(folder), state)


def assert_same_numbers(folder: Path, whole: Path) -> None:
    """Assert that both folders have the same numbers to the last digit, except times."""
    found, expected = (
        pd.read_csv(path / "metrics.csv", dtype=str).filter(regex="^(?!time/)").sort_index(axis=1)
        for path in (folder, whole)
    )
    pd.testing.assert_frame_equal(found, expected)
    summaries = [json.loads((path / "summary.json").read_text()) for path in (folder, whole)]
    for summary in summaries:
        assert summary.pop("train_seconds") > 0
    assert summaries[0] == summaries[1]
