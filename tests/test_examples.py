"""Each example in docs/examples learns, by the command that its page names or for a few updates."""

import math
import runpy

import numpy as np
import pytest

from tests.examples import FOLDER
from tests.figures import rendered
from tests.runs import run_command
from torch_qpmpc.experiment.run_folder import read_summary
from torch_qpmpc.experiment.tasks import TASKS

SCRIPTS = FOLDER / "torchrl"
SHORT = (
    *("updates=2", "eval_interval=2", "log_interval=1", "warmup_steps=10", "batch_size=16"),
    *("task.eval_steps=3", "rivals=true", "replay_capacity=8000", "gate=false"),
)
#: Not scripts that register no task; one of them is quick.
NAMES = sorted(x.stem for x in FOLDER.glob("*.py") if "register(" in x.read_text("utf-8"))
MARKS = {name: () if name == "house" else pytest.mark.slow for name in NAMES}


@pytest.mark.usefixtures("rough_fits")
@pytest.mark.parametrize("name", [pytest.param(x, marks=mark) for x, mark in MARKS.items()])
def test_an_example_learns_for_two_updates(name, tmp_path):
    file = FOLDER / f"{name}.py"
    run_command(f"task.file={file}", *SHORT, f"hydra.run.dir={tmp_path}")
    summary = read_summary(tmp_path)
    assert (summary["task"], summary["updates"], summary["unsolved"]) == (name, 2, 0)
    ends = ("start", "final", "true_model")[: 2 + (TASKS[name].true_scheme is not None)]
    assert all(math.isfinite(summary[f"J_{end}"]) for end in ends)
    assert {*TASKS[name].rivals} <= {*summary["rivals"]}
    assert (tmp_path / "episode.png").exists()
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 200


@pytest.mark.usefixtures("rough_fits")
def test_the_heat_pump_costs_less_than_a_thermostat_and_no_less_than_the_bound():
    drawn = runpy.run_path(str(FOLDER / "heat_pump.py"))
    one, steps = drawn["days"](2, 5), 96
    plan, bound = drawn["omniscient"](one, steps)
    controller, cost = drawn["from_log"](), drawn["cost"]
    runs = {"on levels": drawn["optimized"](controller, one, steps)}
    runs["thermostat"] = drawn["thermostat"](one, steps)
    assert bound <= cost(one, plan) * (1 + 1e-9) <= cost(one, runs["on levels"])
    assert cost(one, runs["on levels"]) < cost(one, runs["thermostat"])
    assert not controller.review().faults
    for run in (plan, *runs.values()):
        ends = np.flatnonzero(np.diff(run[:, 1]))
        spans = list(zip(np.diff(ends), run[ends[1:], 1], strict=True))
        assert all(length >= (3 if on else 2) for length, on in spans)
    rendered(drawn["figure"](one, runs, slice(0, steps)))


def test_the_figure_of_bad_hours_shows_what_prediction_and_observation_save():
    drawn = runpy.run_path(str(FOLDER / "bad_hours.py"))
    rendered(drawn["figure"]())
    for loops in (drawn["dropout"](), drawn["transfer"]()):
        better, worse = (np.square(rows[:, 0] - rows[:, 2]).sum() for rows in loops.values())
        assert better < 0.8 * worse


#: The scripts of the actor-critic page, two of them quick; all make either plant in the same way.
RUNS = (
    ("ddpg", 3, None),
    pytest.param("td3", 3, None, marks=pytest.mark.slow),
    ("sac", 3, "here:Pendulum-v1"),
    pytest.param("ppo", 1, "Pendulum-v1", marks=pytest.mark.slow),
)


@pytest.mark.filterwarnings("ignore:The env passed to Collector", "ignore:.*rewards")
@pytest.mark.parametrize(("name", "updates", "id"), RUNS)
def test_a_script_of_at_most_60_lines_learns(monkeypatch, tmp_path, name, updates, id):
    monkeypatch.syspath_prepend(SCRIPTS)
    (tmp_path / "here.py").touch()  # a module of the current folder
    monkeypatch.chdir(tmp_path)
    path = SCRIPTS / f"{name}.py"
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 60
    before, after = runpy.run_path(str(path))["main"](updates, id=id)
    assert math.isfinite(after)
    assert after != before
