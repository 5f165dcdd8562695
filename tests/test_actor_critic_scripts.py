"""The scripts of the actor-critic page: short, and each learns for a few updates."""

import math
import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "examples" / "torchrl"
pytestmark = [
    pytest.mark.skipif(not FOLDER.exists(), reason="no docs, as in a wheel's tests"),
    pytest.mark.filterwarnings("ignore:The env passed to Collector", "ignore:.*rewards"),
]


#: Of one plant each: the four scripts make either in the same way.
RUNS = (
    ("ddpg", 3, None),
    ("td3", 3, "here:Pendulum-v1"),
    ("sac", 3, "Pendulum-v1"),
    ("ppo", 1, None),
)


@pytest.mark.parametrize(("name", "updates", "id"), RUNS)
def test_a_script_of_at_most_60_lines_learns(monkeypatch, tmp_path, name, updates, id):
    monkeypatch.syspath_prepend(FOLDER)
    (tmp_path / "here.py").touch()  # a module of the current folder
    monkeypatch.chdir(tmp_path)
    path = FOLDER / f"{name}.py"
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 60
    before, after = runpy.run_path(str(path))["main"](updates, id=id)
    assert math.isfinite(after)
    assert after != before
