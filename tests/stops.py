"""Stopping and resuming runs, and comparing them with undisturbed ones."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from omegaconf import DictConfig
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer

import train
from torch_qpmpc.experiment.run_folder import read_metrics
from torch_qpmpc.experiment.run_state import resumed
from torch_qpmpc.qp.pipeline.solve import SolveLog


def stop(
    monkeypatch: pytest.MonkeyPatch,
    cfg: DictConfig,
    folder: Path,
    update: int,
    signum: int = signal.SIGTERM,
) -> int:
    """Run or resume until ``update``, send a signal there, and return the exit code."""
    state = None
    if (folder / "config.yaml").exists():
        cfg, state = resumed(folder, [])
    left = update - (state["update"] if state else 0)
    entered = []

    def count(log: SolveLog) -> SolveLog:
        entered.append(log)
        if len(entered) == left:
            signal.raise_signal(signum)
        return enter(log)

    enter = SolveLog.__enter__
    with monkeypatch.context() as patch, _a_second_later():
        patch.setattr(SolveLog, "__enter__", count)
        with pytest.raises(SystemExit) as ended:
            train.train(cfg, str(folder), state)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def go_on(folder: Path) -> None:
    """Resume a stopped run and finish it."""
    cfg, state = resumed(folder, [])
    with _a_second_later():
        train.train(cfg, str(folder), state)


@contextlib.contextmanager
def _a_second_later() -> Iterator[None]:
    """Advance TensorBoard's clock by a second: it orders event files by the seconds in names."""
    ahead = next(_seconds)
    clock = SimpleNamespace(time=lambda: time.time() + ahead)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(event_file_writer, "time", clock)
        yield


_seconds = itertools.count(1)


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


def assert_events_are_whole(folder: Path) -> None:
    """Assert that TensorBoard has every number of metrics.csv exactly once."""
    found = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0, "images": 0})
    found.Reload()
    table: Any = read_metrics(folder)
    for column in table:
        logged = table[column].dropna()
        shown = [event for event in found.Scalars(column) if not math.isnan(event.value)]
        assert [event.step for event in shown] == list(logged.index), column
        assert [event.value for event in shown] == pytest.approx(list(logged), rel=1e-6), column
    evaluations = [step for step in table["eval/J"].dropna().index if step]
    for image in found.Tags()["images"]:
        at_the_end = image in ("eval/episode", "eval/policy")
        steps = [event.step for event in found.Images(image)]
        assert steps == (evaluations[-1:] if at_the_end else evaluations), image
    texts = [event.tensor_proto.string_val[0] for event in found.Tensors("config/text_summary")]
    assert len(set(texts)) == 1
