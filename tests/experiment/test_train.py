"""train.py, from the configuration to the run's folder."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from hydra import compose, initialize_config_dir
from matplotlib.image import imread
from numba.core import event
from omegaconf import DictConfig, OmegaConf

import train
from tests.runs import CONFIGS, SMALL, make_config, run_command
from torch_qpmpc import (
    QPMPC,
    DeviationPenalty,
    QPError,
    QPQLearningLoss,
    SystemIdentificationPenalty,
)
from torch_qpmpc.envs import LinearSystem, PointMass
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.checkpoint import load_checkpoint, save_checkpoint
from torch_qpmpc.experiment.launch import LOCK, locked
from torch_qpmpc.experiment.run_folder import read_metrics
from torch_qpmpc.experiment.tasks import make_mpc, make_physics
from torch_qpmpc.mpc.banded import band_distance
from torch_qpmpc.mpc.layout import Layout


def run_small(folder: Path, *overrides: str) -> dict[str, Any]:
    return train.train(make_config(*SMALL, *overrides), str(folder))


#: A table of a run's numbers; pandas' own annotations are too wide.
metrics: Callable[[Path], Any] = read_metrics


def learned_C(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the learned C - C_0 and the signed distance of its entries from the band."""
    state = load_checkpoint(folder / "checkpoint.pt")["mpc"]
    horizon = state["C_0"].shape[0] // 4
    return (state["C"] - state["C_0"]).numpy(), band_distance(Layout(4, 2, horizon)).numpy()


# --- One whole run -------------------------------------------------------------------------------

WHOLE = (
    *("optimizer=adam", "solver=daqp", "seed=5", "constraint=combined"),
    *("updates=90", "eval_interval=35", "gate=false", "rivals=false"),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    return folder, train.train(make_config(*WHOLE), str(folder))


def test_compilation_is_not_counted_as_training(tmp_path, monkeypatch):
    clock, batches = itertools.count(step=1000.0), train.batches

    def compiling(collector: Any) -> Iterator[Any]:
        for batch in batches(collector):
            with event.trigger_event("numba:compile"):
                pass
            yield batch

    monkeypatch.setattr(event, "timer", lambda: next(clock))
    monkeypatch.setattr(train, "batches", compiling)
    assert run_small(tmp_path, "updates=2")["train_seconds"] < 0


def test_a_short_run_learns(whole):
    folder, summary = whole
    assert summary["J_final"] < 0.5 * summary["J_start"]
    assert summary["closed_gap"] > 0.5
    assert summary["J_discounted_final"] < summary["J_discounted_start"]
    assert summary["unsolved"] == 0
    gap = (summary["J_start"] - summary["J_final"]) / (summary["J_start"] - summary["J_true_model"])
    assert summary["closed_gap"] == pytest.approx(gap)
    deviation, distance = learned_C(folder)
    assert np.abs(deviation[distance == 0]).max() > 0, "on the band it has learned"
    assert np.abs(deviation[distance > 0]).max() == 0, "the proximal step leaves nothing above it"
    assert np.abs(deviation[distance < 0]).max() > 0, "what is below is free"
    last = metrics(folder).iloc[-1]
    assert last["structure/above"] == 0
    assert last["structure/below"] == pytest.approx(np.abs(deviation[distance < 0]).sum())


def test_folder_is_complete(whole):
    folder, summary = whole
    assert summary == json.loads((folder / "summary.json").read_text())
    names = {"step": "cholesky", "seed": 5, "constraint": "combined", "noise": "gaussian"}
    assert {**summary, **names, "solver": "daqp", "updates": 90, "ablation": None} == summary
    assert 0 < summary["train_seconds"] < 600
    assert OmegaConf.load(folder / "config.yaml") == make_config(*WHOLE)
    assert np.ptp(imread(folder / "summary.png")[..., :3]) > 0.5
    assert (folder / "episode.png").exists()
    table = metrics(folder)
    assert sorted(table.index) == sorted({*range(0, 91, 10), 35})
    J = table["eval/J"].dropna()
    assert list(J.index) == [0, 35, 70, 90]
    assert (J[0], J[90]) == (summary["J_start"], summary["J_final"])
    logged = table.drop(index=[0, 35])
    columns = ["loss/value", "loss/si", "train/td_error", "train/reward", "train/unsolved"]
    columns += ["train/invalid_reward", "qp/solves", "qp/unsolved", "qp/residual"]
    assert np.isfinite(logged[[*columns, "time/collect", "time/update", "time/qp"]]).all(axis=None)
    assert logged["qp/residual"].max() < 1e-6


def test_checkpoint_is_the_learned_qp(whole):
    folder, summary = whole
    cfg: Any = OmegaConf.load(folder / "config.yaml")
    mpc = QPMPC.load(folder / "checkpoint.pt")
    loop = evaluate(cfg, mpc.policy, make_physics(cfg))
    np.testing.assert_allclose(loop.J, summary["J_final"], rtol=1e-9)


# --- Small runs ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("constraint", "noise"),
    [
        ("fixed", "gaussian"),
        ("free", "brownian"),
        ("deviation", "gaussian"),
        ("si", "brownian"),
        ("combined", "gaussian"),
    ],
)
def test_each_case_runs(tmp_path, constraint, noise):
    """One noise for each constraint suffices: they are independent."""
    summary = run_small(tmp_path, f"constraint={constraint}", f"noise={noise}")
    assert (summary["constraint"], summary["noise"]) == (constraint, noise)
    table, losses = metrics(tmp_path), {"loss/value"}
    if constraint in ("si", "combined"):
        losses.add("loss/si")
    if constraint in ("deviation", "combined"):
        losses.add("loss/deviation")
    assert {column for column in table if column.startswith("loss/")} == losses
    assert np.isfinite(table.drop(index=0)[sorted(losses)]).all(axis=None)
    deviation, distance = learned_C(tmp_path)
    moved = {side: np.abs(deviation[np.sign(distance) == side]).max() > 0 for side in (-1, 0, 1)}
    free = constraint in ("free", "si")
    assert moved == {-1: constraint != "fixed", 0: constraint != "fixed", 1: free}


def test_the_si_penalty_begins_with_the_first_window_of_n_steps(tmp_path):
    run_small(tmp_path, "constraint=identified", "warmup_steps=1", "task.horizon=3")
    assert metrics(tmp_path)["loss/si"].isna().tolist() == [True, True, False, False, False]


STREAM = (
    *("task=gros_zanon", "solver=daqp", "task.horizon=4", "task.eval_steps=20"),
    *("figures=false", "gate=false", "rivals=false"),
)


def test_a_stream_whose_transitions_are_used_once_learns(tmp_path):
    cfg = make_config(*STREAM, "replay=false", "updates=24", "eval_interval=12", "seed=69")
    summary = train.train(cfg, str(tmp_path))
    assert summary["unsolved"] == 0
    assert summary["J_final"] < 0.5 * summary["J_start"]
    assert summary["train_cost_last_tenth"] < summary["train_cost"] < 0.6
    table = metrics(tmp_path)
    moved = ["c", "A_0", "B_1", "b_0", "lb_0", "q_4"]
    assert (table[[f"theta/{name}" for name in moved]].dropna().std() > 0).all()
    hard = table[["theta/lb_2", "theta/ub_2"]].dropna()
    assert (hard == [-1.0, 1.0]).all(axis=None)
    violation = table["train/violation"].dropna()
    assert (violation.diff().dropna() >= 0).all()
    assert 0 < violation[24] == pytest.approx(summary["train_violation"])


@pytest.mark.parametrize(
    ("optimizer", "structure"), [("adam", "varying"), ("gauss_newton", "tied")]
)
def test_a_scheme_is_released_in_mid_training(tmp_path, monkeypatch, optimizer, structure):
    seen = []

    def release(mpc: QPMPC) -> None:
        s = torch.linspace(-1, 1, 20).double().reshape(5, 4)
        before = mpc.value(s), mpc.policy(s)
        QPMPC.release(mpc)
        seen.append((before, (mpc.value(s), mpc.policy(s))))

    def make(cfg: DictConfig, physics: LinearSystem, _: None) -> QPMPC:
        mpc = make_mpc(cfg, physics)
        monkeypatch.setattr(mpc, "release", partial(release, mpc))
        return mpc

    monkeypatch.setattr(train, "make_mpc", make)
    options = ("constraint=mpc", f"constraint.structure={structure}", "release=2")
    run_small(tmp_path, *options, f"optimizer={optimizer}", "updates=4", "batch_size=8")
    ((before, after),) = seen
    torch.testing.assert_close(after, before, rtol=0, atol=1e-9)
    state = load_checkpoint(tmp_path / "checkpoint.pt")
    assert state["arguments"]["structure"] == "free"
    deviation, distance = learned_C(tmp_path)
    assert np.abs(deviation[distance > 0]).max() > 0, "it has learned what an MPC scheme cannot"


def frame_without_times(folder: Path) -> Any:
    table = metrics(folder)
    return table.drop(columns=[column for column in table if column.startswith("time/")])


def test_a_seed_determines_every_number(tmp_path):
    for name, seed in (("first", 3), ("again", 3), ("other", 4)):
        torch.manual_seed(len(name))  # earlier use of the generator has no effect
        run_small(tmp_path / name, f"seed={seed}")
    first, again, other = (frame_without_times(tmp_path / n) for n in ("first", "again", "other"))
    pd.testing.assert_frame_equal(first, again, check_exact=True)
    assert not np.allclose(first["loss/value"][1:], other["loss/value"][1:])
    assert first["eval/J"][0] != other["eval/J"][0]


@pytest.mark.filterwarnings("ignore:Found an eps value < 0.5")
@pytest.mark.parametrize("name", ["si_raw", "horizon_20"])
def test_an_ablation_runs(tmp_path, name):
    """The others differ in numbers alone, and in choices that other tests run."""
    small = [override for override in SMALL if not override.startswith(("optimizer", "task.hor"))]
    more = ("updates=2", "warmup_steps=20", "task.episode_steps=20", "task.eval_steps=5")
    cfg = make_config(*small, f"+ablation={name}", *more)
    summary = train.train(cfg, str(tmp_path))
    assert (summary["ablation"], summary["step"]) == (name, cfg.step)
    assert summary["unsolved"] == 0


def test_plain_gradient_step(tmp_path):
    run_small(tmp_path / "free", "optimizer=sgd", "constraint=free")
    deviation, _ = learned_C(tmp_path / "free")
    assert 0 < np.abs(deviation).max() < 0.1
    quiet = ("optimizer.lr_cost=0", "optimizer.lr_constraints=0")
    run_small(tmp_path / "still", "optimizer=sgd", "constraint=free", *quiet)
    assert np.abs(learned_C(tmp_path / "still")[0]).max() == 0


def test_uneven_intervals_and_steps(tmp_path):
    """The last update is always evaluated and saved."""
    more = (
        "updates=5",
        "eval_interval=3",
        "log_interval=2",
        "steps_per_update=3",
        "warmup_steps=5",
    )
    summary = run_small(tmp_path, *more)
    assert list(metrics(tmp_path)["eval/J"].dropna().index) == [0, 3, 5]
    assert list(metrics(tmp_path)["loss/value"].dropna().index) == [2, 4]
    assert load_checkpoint(tmp_path / "checkpoint.pt")["update"] == 5
    assert summary["updates"] == 5


def test_another_solver_reaches_the_same(tmp_path):
    for solver in ("daqp", "proxqp"):
        assert run_small(tmp_path / solver, f"solver={solver}", "updates=2")["solver"] == solver
    first, other = (metrics(tmp_path / name)["loss/value"] for name in ("daqp", "proxqp"))
    np.testing.assert_allclose(first, other, rtol=1e-4)


def test_configuration_reaches_the_parts(tmp_path, monkeypatch):
    losses, windows, scales = [], [], []
    loss_value = QPQLearningLoss.loss_value
    si, proximal = SystemIdentificationPenalty.forward, DeviationPenalty.proximal_step_

    def spy_loss(self, tensordict):
        gamma = self.value_estimator.gamma.item()
        losses.append((gamma, self.td_error_clip, self.delay_value, tuple(tensordict.shape)))
        return loss_value(self, tensordict)

    def spy_si(self, C, tau, b):
        windows.append(tuple(tau.shape))
        return si(self, C, tau, b)

    def spy_proximal(self, C, scale):
        scales.append(scale)
        return proximal(self, C, scale)

    monkeypatch.setattr(QPQLearningLoss, "loss_value", spy_loss)
    monkeypatch.setattr(SystemIdentificationPenalty, "forward", spy_si)
    monkeypatch.setattr(DeviationPenalty, "proximal_step_", spy_proximal)
    more = (
        "constraint=combined",
        "task.gamma=0.5",
        "td_error_clip=7.0",
        "constraint.si.windows=5",
        "batch_size=6",
    )
    run_small(tmp_path, *more, "optimizer.final_fraction=0.2", "optimizer.lr_cost=0.125")
    assert losses == [(0.5, 7.0, False, (6,))] * 4
    assert windows == [(5, 22)] * 4
    assert scales == pytest.approx([1.0, 0.8, 0.6, 0.4]), "it falls with the rates"
    groups = load_checkpoint(tmp_path / "checkpoint.pt")["optimizer"]["param_groups"]
    assert groups[0]["lr"] == pytest.approx(0.125 * 0.2)


def test_training_continues_past_unsolved_qps(tmp_path):
    """Hard state bounds are infeasible at high velocities."""
    more = ("task.state_slack=inf", "noise.std=0.5", "constraint=free")
    summary = run_small(tmp_path, *more, "task.episode_steps=5", "eval_interval=9")
    table = metrics(tmp_path).drop(index=0)
    assert summary["unsolved"] == table["qp/unsolved"].sum() > 0
    assert table["train/unsolved"].sum() > 0
    assert np.isfinite(table["loss/value"]).all()
    state = load_checkpoint(tmp_path / "checkpoint.pt")["mpc"]
    assert all(value.isfinite().all() for value in state.values())


def test_the_second_order_learns_in_tens_of_updates(tmp_path):
    overrides = ("solver=daqp", "seed=5", "constraint=combined", "figures=false", "gate=false")
    summary = train.train(make_config(*overrides, "updates=40", "eval_interval=40"), str(tmp_path))
    assert summary["closed_gap"] > 0.85
    assert summary["unsolved"] == 0
    table = metrics(tmp_path)
    errors = table["train/td_error"]
    assert errors.iloc[-10:].mean() < 0.5 * errors.iloc[1:6].mean()
    assert (table["train/accepted"].dropna() == 1).mean() > 0.7
    assert table["train/damping"].min() >= 0.03
    deviation, distance = learned_C(tmp_path)
    assert (deviation[distance > 0] == 0).all(), "the proximal step holds it exactly"
    assert np.isfinite(table["loss/si"].dropna()).all()


def test_a_bad_configuration_writes_nothing(tmp_path):
    with pytest.raises(QPError, match=r"task\.horizon: got 0"):
        run_small(tmp_path / "run", "task.horizon=0")
    assert not (tmp_path / "run").exists()


# --- The command ---------------------------------------------------------------------------------


def test_command(tmp_path, monkeypatch, capsys):
    """`python train.py ..` prints a table and below it the run's folder."""
    monkeypatch.chdir(tmp_path)
    run_command(*SMALL, "constraint=combined", "noise=brownian")
    lines = capsys.readouterr().out.splitlines()
    folder = Path(lines[-1])
    assert folder.parent == tmp_path / "runs" / "point_mass" / "brownian-combined"
    assert folder.name.startswith("seed1-")
    assert json.loads((folder / "summary.json").read_text())["noise"] == "brownian"
    assert any(line.startswith("J discounted") for line in lines)


def test_impossible_value_on_the_command_line(tmp_path, monkeypatch, capsys):
    """The message is one sentence: Python prints a SystemExit's text without a traceback."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"^task\.gamma: got 1\.5"):
        run_command("task.gamma=1.5")
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("mistake", "sentence"),
    [
        ("batchsize=3", "batchsize: got an unknown key"),
        ("study=paper", "append to your default list use +study=paper"),
        ("optimizer.lr_cost=1", "Could not override 'optimizer.lr_cost'"),
        ("+batchsize=3", "batchsize: got an unknown key"),
        ("constraint=none", "Could not find 'constraint/none'"),
    ],
)
def test_misspelt_key_on_the_command_line(tmp_path, monkeypatch, capsys, mistake, sentence):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as error:
        run_command(mistake)
    assert error.value.code not in (0, None)
    assert sentence in capsys.readouterr().err + str(error.value.code)


# --- Folders that are in use or hold a run ------------------------------------------------------

TINY = (*SMALL, "task.eval_steps=5")


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != LOCK)
    return {str(path): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def stopped_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stop a run after the checkpoint of its second update."""
    folder = tmp_path_factory.mktemp("stopped") / "run"

    def killed(*given: Any) -> None:
        save_checkpoint(*given)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "save_checkpoint", killed)
        with pytest.raises(KeyboardInterrupt):
            train.train(make_config(*TINY), str(folder))
    return folder


@pytest.fixture
def stopped(stopped_run: Path, tmp_path: Path) -> Path:
    """Copy the stopped run."""
    return shutil.copytree(stopped_run, tmp_path / "run")


def test_a_finished_run_is_not_overwritten(tmp_path):
    folder = tmp_path / "run"
    (folder / ".hydra").mkdir(parents=True)
    for name in ("train.log", ".hydra/config.yaml", LOCK):  # left by Hydra and by a killed run
        (folder / name).touch()
    run_command(*TINY, f"hydra.run.dir={folder}")
    before = contents(folder)
    message = (
        f"^folder: got {folder}, which holds a finished run, expected one without a run. "
        "Choose another folder with hydra.run.dir=FOLDER.$"
    )
    with pytest.raises(SystemExit, match=message):
        run_command(*TINY, "seed=2", f"hydra.run.dir={folder}")
    assert contents(folder) == before


def test_a_stopped_run_is_not_overwritten_but_resumes(stopped):
    before = contents(stopped)
    message = (
        f"^folder: got {stopped}, which holds a stopped run, expected one without a run. "
        f"Resume it with resume={stopped}, or choose another folder with hydra.run.dir=FOLDER.$"
    )
    with pytest.raises(SystemExit, match=message):
        run_command(*TINY, f"hydra.run.dir={stopped}")
    assert contents(stopped) == before
    run_command(f"resume={stopped}")
    assert (stopped / "summary.json").exists()


@pytest.mark.parametrize("name", ["config.yaml", "checkpoint.pt"])
def test_the_message_offers_no_resume_of_a_broken_run(stopped, name):
    (stopped / name).write_text("[: garbage")
    message = "a stopped run, expected one without a run. Choose another folder with hydra"
    with pytest.raises(SystemExit, match=message):
        run_command(*TINY, f"hydra.run.dir={stopped}")


def test_a_folder_in_use_is_refused(stopped):
    before = contents(stopped)
    for overrides in ((*TINY, f"hydra.run.dir={stopped}"), (f"resume={stopped}",)):
        with locked(stopped, ""), pytest.raises(SystemExit, match=f"got {stopped}, in use by "):
            run_command(*overrides)
    assert contents(stopped) == before


def test_a_run_resumes_only_in_its_own_folder(stopped, tmp_path):
    message = f"got {tmp_path}/other with resume={stopped}, expected {stopped}. A run resumes in i"
    with pytest.raises(SystemExit, match=message):
        run_command(f"resume={stopped}", f"hydra.run.dir={tmp_path}/other")


def test_runs_that_start_in_the_same_second_have_folders_of_their_own():
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        hydras = [compose("config", return_hydra_config=True).hydra for _ in range(3)]
    assert len({hydra.run.dir for hydra in hydras}) == 3
    assert len({hydra.sweep.dir for hydra in hydras}) == 3
    assert re.fullmatch(
        r"runs/point_mass/gaussian-identified/seed1-\d{8}-\d{6}-\d{6}", hydras[0].run.dir
    )


# --- Gymnasium -----------------------------------------------------------------------------------

PENDULUM = (
    "task.A=[[1,0,0],[0,1.0375,.05],[0,.75,1]]",
    "task.B=[[0],[.0075],[.15]]",
    "task.stage_weight=[[0,0,0,0],[0,2,0,0],[0,0,.2,0],[0,0,0,.1]]",
)
SHORT = ("solver=daqp", "updates=3", "eval_interval=3", "warmup_steps=12", "task.eval_steps=5")


def test_any_gymnasium_environment_is_a_task(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    A, B, W = PointMass().A.tolist(), PointMass().B.tolist(), torch.eye(6).tolist()
    model = (f"task.A={A}", f"task.B={B}", f"task.stage_weight={W}")
    id = "torch_qpmpc/PointMass-v0"
    run_command("task=gymnasium", f"task.id={id}", *model, *SHORT, "figures=false")
    folder = Path(capsys.readouterr().out.splitlines()[-1])
    assert folder.parent == tmp_path / "runs" / "gymnasium" / id / "none-deviation"
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["task"], summary["updates"], summary["unsolved"]) == ("gymnasium", 3, 0)
    assert math.isfinite(summary["J_final"])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((), r"^task.id: got '\?\?\?', expected the id of a Gymnasium env.* task.id=Pendulum-v1"),
        (("task.id=Pendulum-v9",), "^task.id: got 'Pendulum-v9', expected an environment that Gym"),
        (("task.id=CartPole-v1",), r"^task.id: got 'CartPole-v1', whose action space is Discrete"),
        (("task.id=Pendulum-v1",), r"^task.A: got null, expected the rows of a matrix \(3, 3\)"),
        (
            ("task.id=Pendulum-v1", *PENDULUM[:1]),
            r"^task.B: got null, .* \(3, 1\) .* finite differences .*'task.B=\[\[0\],\[.1\]\]'",
        ),
        (("task.id=Pendulum-v1", *PENDULUM[:2]), r"^task.stage_weight: got null, .* \(4, 4\)"),
    ],
)
def test_missing_keys_of_a_gymnasium_task_are_named(tmp_path, monkeypatch, overrides, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=message):
        run_command("task=gymnasium", *overrides, *SHORT)


# --- Progress -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("terminal", "quiet"), [(True, False), (True, True), (False, False)])
def test_a_bar_names_the_first_evaluation(tmp_path, capsys, monkeypatch, terminal, quiet):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    cfg = make_config(*TINY, "updates=2")
    train.train(cfg, str(tmp_path), quiet=quiet)
    shown = capsys.readouterr().err
    for line in ("first evaluation:", "start", "true model"):
        assert (line in shown) is (terminal and not quiet), line
    assert ("2/2" in shown) is not quiet
