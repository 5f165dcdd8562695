"""Each logger writes everything logged into the run's folder, also after a resume."""

from __future__ import annotations

import importlib.util
import json
import re
import time
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2

import train
from tests.runs import SMALL, make_config
from torch_qpmpc import QPError
from torch_qpmpc.experiment.loggers import EXTRAS, RunLogger
from torch_qpmpc.experiment.run_folder import RunFolder

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "loggers.md"


@pytest.fixture(autouse=True)
def local(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the loggers offline."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")


def stop_and_go_on(folder: Path, name: str) -> None:
    """Log a run that stops after its third update's checkpoint, and resume it."""
    cfg = make_config(f"logger={name}", "log_interval=1", "eval_interval=3", "seed=7")
    with RunFolder(folder, cfg) as run:
        for update in range(5):
            run.log({"loss/value": 1 / (update + 1)}, update)
        run.figure("structure/C", Figure(figsize=(1, 1)), 3)
    with RunFolder(folder, cfg, after=3) as run:
        run.log({"loss/value": 0.2}, 4)
        run.log({"loss/value": 0.1, "eval/J": 3.0}, 5)
        run.figure("structure/C", Figure(figsize=(1, 1)), 5)
        run.finish({"J_final": 3.0, "seed": 7})


def test_csv(tmp_path):
    stop_and_go_on(tmp_path, "csv")
    scalars = tmp_path / "csv" / "scalars"
    loss = pd.read_csv(scalars / "loss" / "value.csv", header=None)
    assert loss[0].tolist() == [0, 1, 2, 3, 4, 5], "each update once"
    assert loss[1].tolist() == pytest.approx([1, 1 / 2, 1 / 3, 1 / 4, 0.2, 0.1])
    assert (scalars / "eval" / "J.csv").read_text() == "5,3.0\n"
    assert (scalars / "hparam" / "J_final.csv").read_text() == "0,3.0\n"
    assert (tmp_path / "csv" / "figures" / "structure" / "C-5.png").exists()
    (settings,) = (tmp_path / "csv" / "texts").iterdir()
    assert "seed: 7" in settings.read_text().splitlines()
    assert not (tmp_path / "tensorboard").exists()


def written(file: Path, name: str) -> bool:
    """Wait until a file has the name: W&B's service writes after the run has ended."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if name.encode() in file.read_bytes():
            return True
        time.sleep(0.2)
    return False


def test_wandb(tmp_path):
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    stop_and_go_on(tmp_path, "wandb")
    id = (tmp_path / "wandb-id.txt").read_text()
    records = sorted((tmp_path / "wandb").glob(f"offline-run-*/run-{id}.wandb"))
    assert len(records) == 2, "both parts of one run at W&B"
    for record, names in zip(records, ((), ("eval/J", "hparam/J_final")), strict=True):
        for name in ("loss/value", "structure/C", *names):
            assert written(record, name)
    assert len(list((tmp_path / "wandb").rglob("*.png"))) == 2


def test_mlflow(tmp_path):
    pytest.importorskip("mlflow", reason="the extra mlflow is not installed")
    from mlflow import MlflowClient

    stop_and_go_on(tmp_path, "mlflow")
    client = MlflowClient((tmp_path / "mlflow").as_uri())
    experiment = client.get_experiment_by_name("torch_qpmpc")
    assert experiment is not None
    last, first = client.search_runs([experiment.experiment_id], order_by=["start_time DESC"])
    for run, updates in ((first, range(5)), (last, range(6))):
        logged = client.get_metric_history(run.info.run_id, "loss/value")
        assert sorted(metric.step for metric in logged) == [*updates]
        assert run.data.params["seed"] == "7"
        assert run.info.status == "FINISHED"
    assert (last.data.metrics["eval/J"], last.data.metrics["hparam/J_final"]) == (3.0, 3.0)
    assert len(list((tmp_path / "mlflow").rglob("C-*.png"))) == 2


@pytest.mark.parametrize("name", EXTRAS)
def test_a_logger_that_is_not_installed_is_named_before_anything_is_written(
    tmp_path, monkeypatch, name
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    message = (
        f"^logger: got {name}, which is not installed, expected an installed logger. "
        rf"Install it: pip install {name}\.$"
    )
    with pytest.raises(QPError, match=message):
        RunLogger(name, tmp_path, {})
    with pytest.raises(QPError, match=message):
        train.train(make_config(f"logger={name}"), str(tmp_path))
    assert not list(tmp_path.iterdir())


def test_training_logs_by_the_logger_of_the_configuration(tmp_path):
    cfg = make_config(*SMALL, "logger=csv", "figures=false", "task.eval_steps=5", "updates=2")
    summary = train.train(cfg, str(tmp_path))
    assert {"csv", "metrics.csv", "summary.json"} <= {path.name for path in tmp_path.iterdir()}
    J = pd.read_csv(tmp_path / "csv" / "scalars" / "eval" / "J.csv", header=None)[1]
    assert J.iloc[-1] == pytest.approx(summary["J_final"])


@pytest.mark.skipif(not PAGE.exists(), reason="no docs, as in a wheel's tests")
@pytest.mark.parametrize(
    "overrides",
    [
        ("gate=true", "constraint=mpc", "optimizer=gauss_newton"),
        ("constraint=combined", "noise=brownian"),
    ],
    ids=lambda overrides: overrides[0],
)
def test_the_page_names_each_scalar_file_and_key_of_the_summary(tmp_path, overrides):
    summary = train.train(make_config(*SMALL, *overrides), str(tmp_path), quiet=True)
    text = PAGE.read_text(encoding="utf-8")
    names = {*re.findall(r"`([\w./-]+)`", text)}
    for scalar in {*pd.read_csv(tmp_path / "metrics.csv").columns} - {"update"}:
        assert scalar in names or scalar.startswith(("theta/", "eval/J_")), scalar
    for file in tmp_path.iterdir():
        assert {file.name, f"{file.name}/"} & names, file.name
    for key in json.loads((tmp_path / "summary.json").read_text()):
        assert key in names or key.startswith("J_discounted_"), key
    assert summary["J_best"] > 0


def test_tensorboard_opens_on_scalars_that_a_run_logs(tmp_path):
    train.train(make_config(*SMALL), str(tmp_path), quiet=True)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    (event,) = events.Tensors("custom_scalars__config__")
    created: Any = layout_pb2  # its classes are created at run time
    layout = created.Layout.FromString(event.tensor_proto.string_val[0])
    charts = [chart for category in layout.category for chart in category.chart]
    assert len(charts) == 2
    for chart in charts:
        for pattern in chart.multiline.tag:
            assert any(re.search(pattern, tag) for tag in events.Tags()["scalars"]), pattern
