"""The first lines of a run, and the text of `python train.py --help`."""

from __future__ import annotations

from pathlib import Path

import numba
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tests.runs import CONFIGS, make_config
from torch_qpmpc.experiment.announcement import COMPILING, announcement, compilation_named
from torch_qpmpc.experiment.launch import Launch


def test_a_run_is_described():
    first, second = announcement(make_config("task=pendulum", "seed=3"), "runs/x").splitlines()
    assert first == (
        "100 updates: task gymnasium Pendulum-v1, noise none, constraint deviation, "
        "optimizer gauss_newton, solver proxqp, seed 3"
    )
    assert second == "Folder: runs/x"
    assert "1000 updates, 40 of them done: " in announcement(make_config("optimizer=adam"), "x", 40)


def test_a_run_is_announced_and_those_of_a_sweep_are_not(tmp_path, capsys):
    for sweep in (True, False):
        assert capsys.readouterr().out == ""
        Launch(str(tmp_path), [], sweep).settle(make_config())
    assert capsys.readouterr().out == announcement(make_config(), str(tmp_path)) + "\n"


@pytest.mark.parametrize(
    ("module", "expected"), [("torch_qpmpc.qp.kernels.sample", COMPILING + "\n"), ("users", "")]
)
def test_compilation_is_named_while_a_kernel_compiles(capsys, module, expected):
    def kernel(x):
        return x + 1

    kernel.__module__ = module
    compiled = numba.njit(kernel)
    with compilation_named():
        assert capsys.readouterr().out == ""
        compiled(1)
        assert capsys.readouterr().out == expected
        compiled(2)  # has its machine code
        compiled(2.0)  # compiles again: the line has been printed
        assert capsys.readouterr().out == ""
    compiled(2j)
    assert capsys.readouterr().out == ""


def help_text() -> str:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        cfg = compose("config", return_hydra_config=True)
    OmegaConf.set_readonly(cfg, False)
    return cfg.hydra.help.template


@pytest.mark.parametrize("group", ["constraint", "task", "noise", "optimizer"])
def test_the_help_lists_every_choice(group):
    words = set(help_text().replace(",", " ").replace(";", " ").split())
    names = {path.stem for path in Path(CONFIGS, group).glob("*.yaml")}
    assert names
    assert names <= words, f"missing: {sorted(names - words)}"


def test_the_helps_defaults_are_those_of_the_configuration():
    cfg, text = make_config(), help_text()
    settings = text[text.index("Keys\n") : text.index("All keys")].splitlines()[1:]
    shown = dict(line.split()[0].split("=", 1) for line in settings if line.strip())
    assert len(shown) == 13
    del shown["hydra.run.dir"]
    values = {key: OmegaConf.select(cfg, key) for key in shown}
    words = {True: "true", False: "false", None: "null"}
    assert shown == {
        key: words[x] if isinstance(x, bool | None) else str(x) for key, x in values.items()
    }
    for line in text.splitlines():
        assert len(line) <= 100, line
