"""Sweeps: launchers, finished and stopped runs, and sub-folders."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.runs import SMALL, ended, run_command
from torch_qpmpc.experiment.launch import sub_folder

ROOT = Path(__file__).parents[2]
#: The settings of each launcher but `cores`, which test_docs.py runs.
LAUNCHERS = {
    "submitit_local": ["hydra.launcher.cpus_per_task=1"],
    "ray": [
        "+hydra.launcher.ray.init.num_cpus=1",
        "+hydra.launcher.ray.init.include_dashboard=false",
        "hydra.launcher.ray.init.address=local",
    ],
}


def arguments(folder: Path, *overrides: str) -> list[str]:
    study = ("-m", "+study=paper", "constraint=free", "noise=gaussian")
    short = ("updates=1", "eval_interval=1", "task.eval_steps=2")
    return [*study, *SMALL, *short, f"hydra.sweep.dir={folder}", *overrides]


@pytest.mark.parametrize(
    "launcher",
    [
        pytest.param("submitit_local", marks=pytest.mark.slow),
        pytest.param("ray", marks=pytest.mark.ray),
    ],
)
def test_a_launcher_runs_the_study(launcher, tmp_path):
    launch = (f"hydra/launcher={launcher}", *LAUNCHERS[launcher])
    overrides = arguments(tmp_path, "seed=1,2", *launch)
    # Ray's workers have a low priority by default and would wait for other tests.
    variables: Any = {"PYTHONPATH": str(ROOT), "RAY_worker_niceness": "0"}
    ended(sys.executable, "train.py", *overrides, **variables)
    summaries = [json.loads(path.read_text()) for path in tmp_path.glob("*/summary.json")]
    assert sorted(summary["seed"] for summary in summaries) == [1, 2]


def sweep(folder: Path, *overrides: str) -> None:
    run_command(*arguments(folder, "hydra/launcher=basic", *overrides))


def test_a_sweep_resumes(tmp_path, capsys):
    """Of two runs one has finished and one was stopped; later the settings change."""
    sweep(tmp_path, "seed=1")
    first, second = (tmp_path / f"gaussian-free-seed{seed}" for seed in (1, 2))
    before = (first / "checkpoint.pt").stat().st_mtime_ns
    (second / "tensorboard").mkdir(parents=True)
    (second / "tensorboard" / "stale").touch()
    shutil.copy(first / "config.yaml", second)
    settings = (second / "config.yaml").read_text()
    (second / "config.yaml").write_text(settings.replace("seed: 1\n", "seed: 2\n", 1))

    sweep(tmp_path, "seed=1,2")
    assert (first / "checkpoint.pt").stat().st_mtime_ns == before
    assert (second / "summary.json").exists()
    assert not (second / "tensorboard" / "stale").exists()
    assert capsys.readouterr().out.endswith(f"\npython -m torch_qpmpc.report {tmp_path}\n")

    with pytest.raises(SystemExit) as changed:
        sweep(tmp_path, "seed=1", "exploration_std=0.2")
    assert changed.value.code == 1
    sentence = "holds a run with exploration_std=0.3, expected exploration_std=0.2. Choose another"
    assert f"{sentence} folder with hydra.sweep.dir=FOLDER." in capsys.readouterr().err
    assert (first / "checkpoint.pt").stat().st_mtime_ns == before


def test_sub_folders_are_named_by_what_the_sweep_varies(tmp_path):
    sweep(tmp_path, "seed=1", "exploration_std=0.1,0.2", "+ablation=reference")
    found = sorted(file.parent.name for file in tmp_path.glob("*/summary.json"))
    assert found == [f"gaussian-free-seed1-exploration_std={std}" for std in (0.1, 0.2)]
    name = sub_folder("seed1", "+ablation=sdp,a.b={c: 1}")
    assert name == "seed1-ablation=sdp,a.b=_c_1_"
    assert sub_folder("seed1", "") == "seed1"
