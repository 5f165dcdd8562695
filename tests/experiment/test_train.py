"""train.py, from the configuration to the run's folder."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

import train
from tests.runs import CONFIGS, SMALL, make_config, run_command
from tests.stops import assert_same_numbers, contents
from torch_qpmpc import QPError
from torch_qpmpc.envs import PointMass, PointMassGymEnv
from torch_qpmpc.experiment import evaluation
from torch_qpmpc.experiment import metrics as metrics_of_runs
from torch_qpmpc.experiment.launch import LOCK
from torch_qpmpc.experiment.run_folder import read_config, read_metrics
from torch_qpmpc.files import load_file
from torch_qpmpc.mpc.layout import Layout, band_distance
from torch_qpmpc.mpc.state import KIND


def run_small(folder: Path, *overrides: str) -> dict[str, Any]:
    return train.train(make_config(*SMALL, *overrides), str(folder))


#: A table of a run's numbers; pandas' own annotations are too wide.
metrics: Callable[[Path], Any] = read_metrics


def learned_C(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the learned C - C_0 and the signed distance of its entries from the band."""
    state = load_file(folder / "checkpoint.pt", KIND)["mpc"]
    horizon = state["C_0"].shape[0] // 4
    return (state["C"] - state["C_0"]).numpy(), band_distance(Layout(4, 2, horizon)).numpy()


WHOLE = (
    *("optimizer=adam", "solver=daqp", "seed=5", "constraint=combined"),
    *("updates=30", "eval_interval=25", "gate=false", "rivals=false"),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    return folder, train.train(make_config(*WHOLE), str(folder))


def test_a_short_run_learns(whole):
    folder, summary = whole
    assert summary["J_final"] < 0.5 * summary["J_start"]
    assert summary["closed_gap"] > 0.5
    assert summary["J_discounted_final"] < summary["J_discounted_start"]
    assert summary["unsolved"] == 0
    deviation, distance = learned_C(folder)
    assert np.abs(deviation[distance == 0]).max() > 0, "on the band it has learned"
    assert np.abs(deviation[distance > 0]).max() == 0, "the proximal step leaves nothing above it"
    assert np.abs(deviation[distance < 0]).max() > 0, "what is below is free"


def test_folder_is_complete(whole):
    folder, summary = whole
    assert summary == json.loads((folder / "summary.json").read_text())
    names = {"step": "cholesky", "seed": 5, "constraint": "combined", "noise": "gaussian"}
    assert {**summary, **names, "solver": "daqp", "updates": 30, "ablation": None} == summary
    assert 0 < summary["train_seconds"] < 600
    assert read_config(folder) == make_config(*WHOLE)
    assert (folder / "summary.png").exists()
    assert (folder / "episode.png").exists()
    table = metrics(folder)
    assert sorted(table.index) == sorted({*range(0, 31, 10), 25})
    J = table["eval/J"].dropna()
    assert list(J.index) == [0, 25, 30]
    assert (J[0], J[30]) == (summary["J_start"], summary["J_final"])
    columns = ["loss/value", "loss/si", "train/td_error", "train/reward", "qp/solves", "time/qp"]
    assert np.isfinite(table.drop(index=[0, 25])[columns]).all(axis=None)
    assert table["qp/residual"].max() < 1e-6


@pytest.mark.parametrize(
    ("constraint", "noise", "losses", "free"),
    [
        ("fixed", "gaussian", [], (False, False, False)),
        ("free", "brownian", [], (True, True, True)),
        ("deviation", "gaussian", ["loss/deviation"], (True, True, False)),
        ("si", "brownian", ["loss/si"], (True, True, True)),
        ("combined", "gaussian", ["loss/deviation", "loss/si"], (True, True, False)),
    ],
)
def test_each_case_runs(tmp_path, constraint, noise, losses, free):
    """One noise for each constraint suffices: they are independent."""
    run_small(tmp_path, f"constraint={constraint}", f"noise={noise}")
    table = metrics(tmp_path)
    assert sorted(x for x in table if x.startswith("loss/")) == [*losses, "loss/value"]
    assert np.isfinite(table.drop(index=0)["loss/value"]).all()
    deviation, distance = learned_C(tmp_path)
    moved = (np.abs(deviation[np.sign(distance) == side]).max() > 0 for side in (-1, 0, 1))
    assert (*moved,) == free


def test_the_si_penalty_begins_with_the_first_window_of_n_steps(tmp_path):
    run_small(tmp_path, "constraint=identified", "warmup_steps=1", "task.horizon=3")
    assert metrics(tmp_path)["loss/si"].isna().tolist() == [True, True, False, False, False]


def test_without_an_episode_of_n_steps_a_run_has_no_si_penalty(tmp_path, monkeypatch):
    vectorised = PointMass.vectorised
    monkeypatch.setattr(
        PointMass, "vectorised", lambda self, n, _, seed: vectorised(self, n, 2, seed)
    )
    run_small(tmp_path, "constraint=si", "task.horizon=3", "updates=8")
    table = metrics(tmp_path)
    assert table.index[-1] == 8
    assert "loss/si" not in table


def test_a_stream_whose_transitions_are_used_once_learns(tmp_path):
    stream = ("task=gros_zanon", "solver=daqp", "task.horizon=4", "task.eval_steps=20")
    stream += ("figures=false", "gate=false", "rivals=false", "replay=false", "seed=69")
    cfg = make_config(*stream, "updates=24", "eval_interval=12")
    summary = train.train(cfg, str(tmp_path))
    assert summary["unsolved"] == 0
    assert summary["J_final"] < 0.5 * summary["J_start"]
    assert summary["train_cost_last_tenth"] < summary["train_cost"] < 0.6
    table = metrics(tmp_path)
    moved = ["c", "A_0", "B_1", "b_0", "lb_0", "q_4"]
    assert (table[[f"theta/{name}" for name in moved]].dropna().std() > 0).all()
    hard = table[["theta/lb_2", "theta/ub_2"]].dropna()
    assert (hard == [-1.0, 1.0]).all(axis=None)


def test_what_the_end_cannot_show_is_said(tmp_path, monkeypatch, capsys):
    """A rival or a figure that fails costs no run."""

    def failing(*_: object) -> None:
        raise RuntimeError("no canvas\nfor a figure")

    monkeypatch.setattr(metrics_of_runs, "summary_figure", failing)
    monkeypatch.setattr(evaluation, "nominal_mpcs", failing)
    summary = run_small(tmp_path, "figures=true", "rivals=[identification]")
    reason = "RuntimeError: no canvas"
    assert summary["missing"] == {"rival identification": reason, "summary.png": reason}
    assert json.loads((tmp_path / "summary.json").read_text())["missing"] == summary["missing"]
    assert (tmp_path / "episode.png").exists()
    assert f"\nThe run has no summary.png: {reason}\n" in capsys.readouterr().out


def test_a_seed_determines_every_number(tmp_path):
    for name, seed in (("first", 3), ("again", 3), ("other", 4)):
        torch.manual_seed(len(name))  # earlier use of the generator has no effect
        run_small(tmp_path / name, f"seed={seed}")
    assert_same_numbers(tmp_path / "first", tmp_path / "again")
    first, other = (metrics(tmp_path / name) for name in ("first", "other"))
    assert not np.allclose(first["loss/value"][1:], other["loss/value"][1:])
    assert first["eval/J"][0] != other["eval/J"][0]


def test_uneven_intervals_and_steps(tmp_path):
    """The last update is always evaluated and saved."""
    more = ("updates=5", "eval_interval=3", "log_interval=2", "steps_per_update=3")
    run_small(tmp_path, *more, "warmup_steps=5")
    assert list(metrics(tmp_path)["eval/J"].dropna().index) == [0, 3, 5]
    assert list(metrics(tmp_path)["loss/value"].dropna().index) == [2, 4]
    assert load_file(tmp_path / "checkpoint.pt", KIND)["update"] == 5


def test_a_bad_configuration_writes_nothing(tmp_path):
    with pytest.raises(QPError, match=r"task\.horizon: got 0"):
        run_small(tmp_path / "run", "task.horizon=0")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("mistake", "sentence"),
    [
        ("task.gamma=1.5", "task.gamma: got 1.5"),
        ("batchsize=3", "batchsize: got an unknown key"),
        ("study=paper", "append to your default list use +study=paper"),
        ("optimizer.lr_cost=1", "Could not override 'optimizer.lr_cost'"),
        ("+batchsize=3", "batchsize: got an unknown key"),
        ("constraint=none", "Could not find 'constraint/none'"),
    ],
)
def test_a_mistake_on_the_command_line_is_named(tmp_path, monkeypatch, capsys, mistake, sentence):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as error:
        run_command(mistake)
    assert error.value.code not in (0, None)
    assert sentence in capsys.readouterr().err + str(error.value.code)


TINY = (*SMALL, "task.eval_steps=5")


def test_a_finished_run_is_shown_again_and_not_overwritten(tmp_path, capsys):
    folder = tmp_path / "run"
    (folder / ".hydra").mkdir(parents=True)
    for name in ("train.log", ".hydra/config.yaml", LOCK):  # left by Hydra and by a killed run
        (folder / name).touch()
    run_command(*TINY, f"hydra.run.dir={folder}")
    before, shown = contents(folder), capsys.readouterr().out
    run_command(*TINY, f"hydra.run.dir={folder}")
    assert capsys.readouterr().out == f"{shown.rstrip()}, which has finished before\n"
    message = (
        f"folder: got {folder}, which holds a run with seed=1, expected seed=2. Choose another"
    )
    with pytest.raises(SystemExit, match=f"^{message} folder with hydra.run.dir=FOLDER.$"):
        run_command(*TINY, "seed=2", f"hydra.run.dir={folder}")
    assert contents(folder) == before
    (folder / "config.yaml").unlink()
    with pytest.raises(SystemExit, match=r"holds a run without its config\.yaml, expected a"):
        run_command(*TINY, f"hydra.run.dir={folder}")


def test_runs_that_start_in_the_same_second_have_folders_of_their_own():
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        hydras = [compose("config", return_hydra_config=True).hydra for _ in range(3)]
    assert len({hydra.run.dir for hydra in hydras}) == 3
    assert len({hydra.sweep.dir for hydra in hydras}) == 3
    parts = Path(hydras[0].run.dir).parts
    assert parts[:3] == ("runs", "point_mass", "gaussian-identified")
    assert parts[3].startswith("seed1-")


SHORT = ("solver=daqp", "updates=3", "eval_interval=3", "warmup_steps=12", "task.eval_steps=5")
SHORT += ("rivals=false",)


class Mass(PointMassGymEnv):
    """Raises, or has rewards of NaN, in a share of its steps."""

    def __init__(self, share: float = 0.0, raises: bool = False, after: int = 0) -> None:
        super().__init__()
        self.share, self.raises, self.after, self.k = share, raises, after, 0

    def step(self, action):
        y, reward, *rest = super().step(action)
        self.k += 1
        if self.k > self.after and self.np_random.random() < self.share:
            if self.raises:
                raise ArithmeticError("the integrator failed")
            reward = float("nan")
        return y, reward, *rest


@pytest.fixture
def mass(register: Callable[..., str]) -> None:
    register(Mass, 50)


@pytest.mark.usefixtures("mass")
def test_any_gymnasium_environment_is_a_task(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    A, B, W = PointMass().A.tolist(), PointMass().B.tolist(), torch.eye(6).tolist()
    model = (f"task.A={A}", f"task.B={B}", f"task.stage_weight={W}")
    id = "Mass-v0"
    run_command("task=gymnasium", f"task.id={id}", *model, *SHORT, "figures=false", "gate=false")
    folder = Path(capsys.readouterr().out.splitlines()[-1])
    assert folder.parent == tmp_path / "runs" / "gymnasium" / id / "none-deviation"
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["task"], summary["unsolved"]) == ("gymnasium", 0)


@pytest.mark.filterwarnings("ignore:The plant ends", "ignore:.*rewards are NaN")
@pytest.mark.usefixtures("mass")
@pytest.mark.parametrize(
    ("start", "share", "raises", "after", "wrong"),
    [
        ("data", 0.01, True, 0, None),
        ("model", 1.0, True, 0, "The plant ends episodes by ArithmeticError: the integrator fail"),
        ("model", 1.0, False, 0, "Return a number from the environment's step, or end the episode"),
        ("data", 0.5, False, 3, "Return a number from the environment's step, or end the episode"),
    ],
)
def test_a_faulty_plant_is_reported(
    tmp_path, monkeypatch, capsys, start, share, raises, after, wrong
):
    """An exception ends an episode, and rewards of NaN the command, after all is written."""
    monkeypatch.chdir(tmp_path)
    A, B, W = PointMass().A.tolist(), PointMass().B.tolist(), torch.eye(6).tolist()
    model = [f"task.A={A}", f"task.B={B}"] if start == "model" else ["start.transitions=200"]
    model += [f"task.stage_weight={W}", f"start={start}", "task.start_episodes=0"]
    options = f"task.kwargs={{share: {share}, raises: {raises}, after: {after}}}"
    arguments = ("task=gymnasium", "task.id=Mass-v0", options, *model, *SHORT, "figures=false")
    arguments += ("task.episode_steps=20", "hydra.run.dir=run")
    if raises and wrong is None:
        run_command(*arguments)
        summary = json.loads((tmp_path / "run" / "summary.json").read_text())
        assert summary["raised"] > 0
        assert math.isfinite(summary["J_best"])
        assert f"The plant ended {summary['raised']} episodes by exc" in capsys.readouterr().out
        return
    with pytest.raises(SystemExit) as error:
        run_command(*arguments)
    assert error.value.code not in (0, None)
    if start == "model" or after:
        assert "reward: got NaN in " in str(error.value)
        assert wrong in str(error.value)
    assert (tmp_path / "run" / "summary.json").exists() == bool(after)
