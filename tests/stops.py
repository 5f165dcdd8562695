"""Stopping and resuming runs, and comparing them with undisturbed ones."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import train
from torch_qpmpc.experiment.config import Config
from torch_qpmpc.experiment.launch import LOCK, settled
from torch_qpmpc.experiment.run_folder import read_config
from torch_qpmpc.qp.pipeline.solve import SolveLog


def stop(monkeypatch: pytest.MonkeyPatch, cfg: Config, folder: Path, update: int) -> None:
    state = None
    if (folder / "config.yaml").exists():
        cfg, state = begun(folder)
    with monkeypatch.context() as patch:
        interrupt(patch, update - (state["update"] if state else 0))
        with pytest.raises(KeyboardInterrupt):
            train.train(cfg, str(folder), state)


def interrupt(monkeypatch: pytest.MonkeyPatch, update: int) -> None:
    """Make the update of this number raise what Ctrl-C does."""
    enter, entered = SolveLog.__enter__, []

    def count(log: SolveLog) -> SolveLog:
        entered.append(log)
        if len(entered) == update:
            raise KeyboardInterrupt
        return enter(log)

    monkeypatch.setattr(SolveLog, "__enter__", count)


def begun(folder: Path) -> tuple[Config, dict[str, Any] | None]:
    cfg = read_config(folder)
    state, summary = settled(cfg, folder, sweep=False)
    assert summary is None
    return cfg, state


def go_on(folder: Path) -> None:
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


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != LOCK)
    return {str(path): path.read_bytes() for path in files}
