"""The sdist and the wheel are complete and minimal; package.yml runs README.md's examples."""

import os
import re
import runpy
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import torch_qpmpc
from tests.runs import ended

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / ".github" / "readme_examples.py"

pytestmark = pytest.mark.skipif(not EXAMPLES.exists(), reason="not a clone of the repository")


def sources(folder: str) -> set[str]:
    found = (path.relative_to(ROOT) for path in (ROOT / folder).rglob("*") if path.is_file())
    return {str(path) for path in found if "__pycache__" not in path.parts}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("dist")
    ended(sys.executable, "-m", "hatchling", "build", "-d", folder)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


def test_the_sdist_trains_and_tests(built):
    with tarfile.open(built[0]) as archive:
        top, files = archive.getnames()[0].split("/")[0], set(archive.getnames())
    assert top == f"torch_qpmpc-{torch_qpmpc.__version__}"
    files = {name.removeprefix(f"{top}/") for name in files}
    alone = {"train.py", "pyproject.toml", "README.md", "LICENSE", "CITATION.cff"}
    alone |= {"CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "PKG-INFO", ".gitignore"}
    alone |= {name for name in sources("docs/examples") if name.endswith(".py")}
    assert files == alone | sources("torch_qpmpc") | sources("configs") | sources("tests")
    assert built[0].stat().st_size < 1e6


def test_the_module_is_train_py(tmp_path, monkeypatch):
    """Here in a clone."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", "task.gama=1"])
    with pytest.raises(SystemExit, match=r"Did you mean task\.gamma\?$"):
        runpy.run_module("torch_qpmpc.train", run_name="__main__")
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_the_module_of_the_wheel_is_its_own_train_py(built, tmp_path):
    """It has a copy of train.py and configs/."""
    folder = built[1].parent / "unpacked"
    zipfile.ZipFile(built[1]).extractall(folder)
    command = [sys.executable, "-m", "torch_qpmpc.train", "task.gama=1"]
    options = {"cwd": tmp_path, "capture_output": True, "text": True}
    environment = os.environ | {"PYTHONPATH": str(folder)}
    refused = subprocess.run(command, check=False, env=environment, **options)
    assert refused.returncode == 1
    assert refused.stderr.endswith("Did you mean task.gamma?\n")
    assert not [*tmp_path.iterdir()]


def test_the_wheel_is_the_package_with_the_command(built):
    with zipfile.ZipFile(built[1]) as archive:
        files = set(archive.namelist())
        (metadata,) = (name for name in files if name.endswith("/METADATA"))
        text = archive.read(metadata).decode()
    command = {f"torch_qpmpc/command/{name}" for name in {"train.py"} | sources("configs")}
    assert {name for name in files if ".dist-info/" not in name} == sources("torch_qpmpc") | command
    assert built[1].stat().st_size < 6.2e5
    assert re.findall(r"^Version: (.*)$", text, re.M) == [torch_qpmpc.__version__]
    assert "torch_qpmpc/py.typed" in files
