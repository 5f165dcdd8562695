"""A stopped and resumed run equals an undisturbed one, number for number."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

import train
from tests.runs import SMALL, make_config, run_command
from tests.stops import assert_same_numbers, begun, contents, go_on, stop
from torch_qpmpc import QPError
from torch_qpmpc.files import load_file, save_file
from torch_qpmpc.mpc.state import KIND

#: The stop is after a checkpoint between rows of metrics, and an episode ends after it.
RUN = (
    *SMALL,
    "updates=8",
    "eval_interval=4",
    "log_interval=3",
    "task.episode_steps=10",
    "task.eval_steps=5",
)
STOP = 5
SECOND = "optimizer=gauss_newton"
DATA = ("start=data", "start.transitions=200", "constraint=free")


@pytest.mark.filterwarnings("ignore:Found an eps value < 0.5")
@pytest.mark.parametrize(
    "overrides",
    [
        ("optimizer=adam", "constraint=mpc", "solver=torch", "step=projection"),
        (SECOND, "constraint=free", "replay=false", "noise=brownian", "steps_per_update=3"),
        (SECOND, "gate=plant", "constraint=mpc", "solver=proxqp"),
        (SECOND, "gate=true", *DATA),
        (SECOND, "task=store", "constraint=combined", "replay_capacity=40"),
    ],
    ids=" ".join,
)
def test_a_resumed_run_equals_an_undisturbed_one(tmp_path, monkeypatch, overrides, store_task):
    cfg = make_config(*RUN, *overrides)
    train.train(cfg, str(tmp_path / "whole"))
    torch.manual_seed(1)
    stop(monkeypatch, cfg, tmp_path / "stopped", STOP)
    torch.manual_seed(2)
    go_on(tmp_path / "stopped")
    assert_same_numbers(tmp_path / "stopped", tmp_path / "whole")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        stop(patch, make_config(*RUN, "eval_interval=2"), folder, 3)
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    train.train(make_config(*RUN, "eval_interval=2"), str(folder))
    return folder


@pytest.fixture
def stopped(run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(run, tmp_path / "run")


def test_a_resumed_run_stops_and_resumes_again(monkeypatch, stopped, whole):
    stop(monkeypatch, make_config(), stopped, STOP)
    go_on(stopped)
    assert_same_numbers(stopped, whole)


def test_the_same_command_goes_on_with_a_stopped_run_and_another_does_not(stopped, whole):
    before, command = contents(stopped), (*RUN, "eval_interval=2", f"hydra.run.dir={stopped}")
    with pytest.raises(SystemExit, match="holds a run with updates=8, expected updates=5"):
        run_command(*command, "updates=5")
    assert contents(stopped) == before
    run_command(*command)
    assert_same_numbers(stopped, whole)


def test_a_run_that_has_no_checkpoint_yet_begins_anew(stopped, whole):
    for checkpoint in stopped.glob("checkpoint*"):
        checkpoint.unlink()
    go_on(stopped)
    assert_same_numbers(stopped, whole)


def test_the_last_checkpoint_is_enough_to_finish(tmp_path, monkeypatch, whole):
    """The run is killed after the last update, before its summary is written."""

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("train.RunFolder.finish", killed)
        with pytest.raises(KeyboardInterrupt):
            train.train(make_config(*RUN, "eval_interval=2"), str(tmp_path))
    state = load_file(tmp_path / "checkpoint.pt", KIND)
    assert (state["replay"], state["collector"], state["update"]) == (None, None, 8)
    go_on(tmp_path)
    assert_same_numbers(tmp_path, whole)


def test_environments_of_gymnasium_start_new_episodes_on_resume(tmp_path, monkeypatch, capsys):
    cfg = make_config(*RUN, "task=pendulum", "noise=none", "updates=4", "eval_interval=2")
    stop(monkeypatch, cfg, tmp_path, 3)
    go_on(tmp_path)
    expected = "Starting new episodes: the state of the environments is not saved."
    assert expected in capsys.readouterr().out
    assert json.loads((tmp_path / "summary.json").read_text())["updates"] == 4


# --- What is refused -----------------------------------------------------------------------------


def test_a_checkpoint_of_another_run_or_layout_is_refused(stopped):
    whole = load_file(stopped / "checkpoint.pt", KIND)
    state = {name: part for name, part in whole.items() if name != "config"}
    save_file(stopped / "checkpoint.pt", KIND, state)
    with pytest.raises(QPError, match="checkpoint: got a saved QPMPC, expected a run's state"):
        begun(stopped)
    torch.save([1, 2], stopped / "checkpoint.pt")
    with pytest.raises(QPError, match=r"path: got .*checkpoint.pt, which another program wrote"):
        begun(stopped)
    cfg = make_config(*RUN, "task.horizon=4", "seed=2", "eval_interval=2")
    save_file(stopped / "checkpoint.pt", KIND, whole)
    OmegaConf.save(cfg.model_dump(exclude_unset=True), stopped / "config.yaml")
    message = r"folder: got .* with seed=1, task.horizon=3, expected seed=2, task"
    with pytest.raises(QPError, match=message):
        begun(stopped)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("loss_module", {"more": torch.zeros(2)}),
        ("mpc", {"C": torch.zeros(2, 2)}),
        ("optimizer", {"param_groups": []}),
        ("scheduler", {"last_epoch": None}),
        ("replay", {"storage": {}}),
        ("collector", {"rng": torch.zeros(3, dtype=torch.uint8)}),
        ("collector", {"episodes": {}}),
        ("tally", {"qps": {"weather": 1.0}}),
    ],
)
def test_a_part_that_does_not_fit_is_named(stopped, part, change):
    cfg, state = begun(stopped)
    state[part].update(change)
    with pytest.raises(QPError, match=rf"^checkpoint: got '{part}' that does not fit \(.*version"):
        train.train(cfg, str(stopped), state)
