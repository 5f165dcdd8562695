"""Every documented command runs to its end: shortened, and with another seed than the page's.

`SHORT` names each line ``python ..`` and ``bash ..`` of README, docs and notebooks, and what
shortens it; a command without an entry fails. ``pytest -m slow -s tests/test_commands.py`` runs
them, page by page in a copy of the repository, and prints their times; those of train.py alone are
quick in one process.
"""

import importlib.util
import json
import os
import re
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.pages import PAGES, ROOT, fenced, needs_docs
from tests.runs import SMALL, ended, make_config, run_command
from torch_qpmpc.experiment.tasks.code import named_task

pytestmark = needs_docs

#: Another seed, few updates, and short closed loops.
FEW = "seed=71 updates=2 eval_interval=2 task.eval_steps=3"
DATA = f"{FEW} start.transitions=200 task.start_episodes=2"
SWEEP = f"{FEW} hydra.launcher.n_jobs=2 hydra.launcher.verbose=0"
CASE = f"{SWEEP} constraint=fixed noise=gaussian"
#: A run that is stopped at its first checkpoint.
MINE = "seed=71 updates=99 eval_interval=9 hydra.run.dir=runs/mine"
LONG = f"python train.py {' '.join(SMALL)} {MINE}"
STOPPED = (
    f"{LONG} & while [ ! -e runs/mine/checkpoint.pt ]; do sleep 0.2; done; kill $!; "
    f"wait $! && exit 1; {LONG}"
)
PENDULUM = "python train.py task=gymnasium task.id=Pendulum-v1 start=data"


class Short(NamedTuple):
    """How a command is shortened.

    ``more`` is added to it, or the shell's command ``instead`` takes its place; ``files`` maps
    places that it reads to blocks of Python of its page. ``needs`` are modules that may be missing.
    """

    more: str = ""
    instead: str = ""
    needs: tuple[str, ...] = ()
    quick: bool = False
    files: tuple[tuple[str, str], ...] = ()


#: Why a command does not run in these tests.
CANNOT = {
    "python docs/examples/fmu_plant.py room.fmu --inputs heat --outputs T --dt 900": "it reads an "
    "FMU of one's own",
    "python -m tests.benchmarks.toolboxes": "it compares packages that are not installed",
    "python3 -m venv .venv": "it makes an environment; .ci/run does, too",
    "python -m tests.benchmarks.one_state --write": "minutes, with osqp, clarabel and casadi",
    "python -m tests.benchmarks.solvers --write": "the same, with piqp, osqp, qpax and more",
    "python -m tests.benchmarks.gpu --write": "it needs a GPU",
    "python -m tests.benchmarks.public_logs FOLDER --write": "its logs are downloaded by hand",
    "python train.py -m +study=paper hydra/launcher=submitit_slurm "
    "hydra.launcher.partition=PARTITION hydra.launcher.timeout_min=60 "
    "hydra.launcher.cpus_per_task=1 hydra.launcher.array_parallelism=40": "it needs Slurm",
}
MY_TASK = (("my_task.py", "register("),)
SHORT = {
    # train.py: one run.
    "python train.py": Short(FEW, quick=True),
    "python train.py --help": Short(),
    "python train.py solver=daqp": Short(FEW),
    "python train.py constraint=free noise=brownian seed=2": Short(FEW),
    "python train.py constraint=deviation": Short(FEW),
    "python train.py constraint=si": Short(FEW),
    "python train.py constraint=combined": Short(FEW),
    "python train.py constraint=identified": Short(FEW),
    "python train.py constraint=deviation constraint.deviation.c_2=1e-3": Short(FEW),
    "python train.py +study=paper constraint=deviation noise=brownian": Short(FEW),
    "python train.py task=gros_zanon solver=daqp": Short(FEW, quick=True),
    "python train.py task=pendulum gate=plant": Short(FEW, quick=True),
    "python train.py task.file=docs/examples/house.py": Short(FEW),
    PENDULUM: Short(DATA),
    f"{PENDULUM} hydra.run.dir=runs/mine": Short(DATA),
    "python train.py task=gymnasium task.id=InvertedPendulum-v5 start=data": Short(
        DATA, needs=("mujoco",)
    ),
    "python train.py start=data start.file=FOLDER/log.pt": Short(
        instead=f"python train.py start=data start.transitions=200 {FEW} hydra.run.dir=FOLDER && "
        f"python train.py start=data start.file=FOLDER/log.pt {FEW}"
    ),
    "python train.py hydra.run.dir=runs/mine": Short(instead=STOPPED),
    # Sweeps, and the tables of their folders.
    "python train.py -m constraint=fixed,free seed=1,2": Short(SWEEP),
    "python train.py -m constraint=fixed,free seed=1,2,3": Short(SWEEP),
    "python train.py -m +study=paper": Short(CASE),
    "python train.py -m +study=ablations": Short(f"{SWEEP} +ablation=reference"),
    "python train.py -m +study=frontier": Short(
        f"{SWEEP} constraint.si.beta=0 constraint.deviation='{{c_1: 1, c_2: 0, c_3: 0}}'"
    ),
    "python train.py -m task.file=docs/examples/short_horizon.py weighted=true eval_seed=777 "
    "seed=range(111,121)": Short(SWEEP),
    "python -m torch_qpmpc.report runs/study-paper": Short(),
    "python -m tests.benchmarks.paper runs/study-paper": Short(),
    "python -m torch_qpmpc.report runs/study-frontier": Short(),
    # A script of one's own.
    "python train.py task.file=my_task.py solver=daqp hydra.run.dir=pole": Short(
        FEW, files=MY_TASK
    ),
    "python my_task.py -m task=pole solver=daqp seed=1,2,3": Short(SWEEP, files=MY_TASK),
    "python docs/examples/heat_pump.py heat_pump.png": Short(),
    "python docs/examples/torchrl/ddpg.py": Short("--updates 2 --seed 71"),
    "python docs/examples/torchrl/sac.py --id Pendulum-v1": Short("--updates 2 --seed 71"),
    # Benchmarks that can be shortened: one row of each.
    "python -m tests.benchmarks.gradient --write": Short("--only daqp"),
    "python -m tests.benchmarks.rivals": Short("--plants Dosing --sizes 500 --seeds 71"),
    "python -m tests.benchmarks.closed_loops": Short("--cases Gros-Zanon --seeds 71"),
    "python -m tests.benchmarks.violation": Short("--seeds 1 --steps 50"),
    "python -m tests.benchmarks.micro_controller --write": Short(
        "--seeds 71 --designs 'N = 40' 'N = 3, a lower price'"
    ),
    "python -m tests.benchmarks.export --write": Short("--problem 'point mass, N = 10'"),
    "python -m tests.benchmarks.improvement": Short(
        "--cases 'Point mass, Brownian noise' --seeds 71"
    ),
    "python -m tests.benchmarks.outside --seeds 16 17 18 19 20": Short(
        "--plants psm --seeds 71", needs=("controlgym",)
    ),
    "python -m tests.benchmarks.nonlinear": Short("--plants Unicycle --seeds 71"),
    "python -m tests.benchmarks.guide --seeds 16 17 18 19 20 --write": Short(
        "--seeds 71", needs=("controlgym",)
    ),
    # The campaigns.
    "python -m tests.campaign --count 20000 --solver daqp": Short(
        "--count 40 --seed 71 --results counts"
    ),
    "python -m tests.campaign --solver 'daqp, warm'": Short(
        "--count 40 --seed 71 --results counts"
    ),
    "python -m tests.campaign --solver --write": Short(),
    "python -m tests.campaign --count 20000 --solver NAME": Short(
        "--count 40 --seed 71 --solver torch --results counts"
    ),
    "python -m tests.campaign.levels": Short("--count 3 --long 2 --times 0"),
    "python -m tests.campaign.numerics --write": Short("--solver daqp"),
    "python -m tests.campaign.numerics --solver NAME": Short("--solver daqp"),
    "python -m tests.campaign.rounding": Short("--count 40 --controllers 1 --seed 71"),
    "python -m tests.campaign.export --count 100000 --write": Short("--count 20"),
    "python -m tests.campaign.units": Short("--count 2 --compiled 1 --first 71"),
    "python -m tests.campaign.soak": Short("--steps 5000"),
    "python -m tests.faults.kill --count 20": Short("--count 1 --seed 71"),
    "python -m tests.faults.long": Short("--updates 200 seed=71"),
    "python -m tests.claims --quick": Short("--only soak"),
    "python -m tests.claims --only tests.campaign": Short("--quick"),
    "python -m tests.claims": Short("--quick --only soak"),
    "python docs/pictures.py prove": Short(),
}
#: Inline names of programs that are no commands.
PROGRAMS = ("python -m torch_qpmpc.train", "python -m torch_qpmpc.report", "python -m tests...")
#: Inline commands that a page's own ones stand for.
TEMPLATES = ("python -m torch_qpmpc.report FOLDER",)


def commands(text: str) -> list[str]:
    """Return the lines of Python and bash in a page's blocks and between its backticks."""
    blocks = [code.replace("\\\n", "") for _, code in fenced(text, "bash")]
    lines = [part for code in blocks for line in code.splitlines() for part in line.split("&&")]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    lines += re.findall(r"`(python3? (?:-m )?[\w/]+\.[^`\n]*)`", prose)
    words = [shlex.split(line, comments=True) for line in lines]
    return [shlex.join(x) for x in words if x and re.fullmatch(r"python3?|bash", x[0])]


def documented() -> dict[str, list[str]]:
    texts = dict(PAGES)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        lines = ["".join(cell["source"]) for cell in cells]
        texts[path.relative_to(ROOT).as_posix()] = "\n".join(lines)
    found = {page: list(dict.fromkeys(commands(text))) for page, text in texts.items()}
    names = {*PROGRAMS, *TEMPLATES}
    return {page: [x for x in of if x not in names] for page, of in found.items()}


DOCUMENTED = documented()
NAMED = {shlex.join(shlex.split(command)): short for command, short in SHORT.items()}
EVERY = (*NAMED, *CANNOT)


def test_each_documented_command_has_an_entry():
    found = {command: page for page, of in DOCUMENTED.items() for command in of}
    unknown = [f"{page}: {x}" for x, page in found.items() if x not in EVERY]
    assert not unknown, "shorten it in SHORT, or say in CANNOT why it does not run"
    assert not {*EVERY} - {*found}, "no page has it any more"
    assert not {*NAMED} & {*CANNOT}


def test_modules_that_commands_run_exist():
    modules = {x.split()[2] for x in EVERY if re.match(r"python -m (tests|torch_qpmpc)\.", x)}
    assert [x for x in modules if importlib.util.find_spec(x) is None] == []


@pytest.mark.parametrize("command", [x for x in EVERY if re.match("python train(?!.*my_task)", x)])
def test_train_commands_have_possible_settings(command, monkeypatch):
    monkeypatch.chdir(ROOT)  # of the paths of examples
    overrides = [word for word in shlex.split(command)[2:] if word not in {"-m", "--help"}]
    # Of a sweep, the first of each choice.
    first = [re.sub(r"=(?:range\()?([\w.]+),[^\[\]]*$", r"=\1", word) for word in overrides]
    make_config(*named_task(first))


@pytest.mark.usefixtures("rough_fits")
@pytest.mark.parametrize("command", [x for x, short in NAMED.items() if short.quick])
def test_a_command_of_one_run_ends(command, tmp_path, monkeypatch):
    """With its tables: nothing is missing at the end."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    quiet = ("figures=false", "hydra.run.dir=run")
    run_command(*shlex.split(f"{command} {NAMED[command].more}")[2:], *quiet)
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["seed"] == 71
    assert "missing" not in summary


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page, of in DOCUMENTED.items() if of])
def test_the_commands_of_a_page_end(page, tmp_path, capsys):
    """One after the other, as a reader would run them, in a copy of the repository."""
    skip = shutil.ignore_patterns(".*", "venv", "runs", "site")
    clone = Path(shutil.copytree(ROOT, tmp_path / "clone", ignore=skip))
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    variables = {"PATH": path, "PYTHONPATH": str(clone), "OMP_NUM_THREADS": "1"}
    blocks = [code for _, code in fenced(PAGES.get(page, ""), "python")]
    for command in DOCUMENTED[page]:
        short, began = NAMED.get(command), time.perf_counter()
        needs = () if short is None else short.needs
        absent = [x for x in needs if not importlib.util.find_spec(x)]
        if short is None or absent:
            why = CANNOT.get(command) or f"{', '.join(absent)} is not installed"
            with capsys.disabled():
                print(f"\n   not run  {command}: {why}", end="")
            continue
        for name, part in short.files:
            script = next(code for code in blocks if part in code)
            (clone / name).write_text(script, encoding="utf-8")
        ended("bash", "-c", short.instead or f"{command} {short.more}", cwd=clone, **variables)
        with capsys.disabled():
            print(f"\n{time.perf_counter() - began:8.1f} s  {command}", end="")
