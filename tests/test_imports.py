"""`import torch_qpmpc`: what it imports, and the names that it imports only when they are used."""

from __future__ import annotations

import subprocess
import sys

import gymnasium
import pytest

import torch_qpmpc

#: Each takes from a third of a second up to as long as torch itself, and no QP needs it.
HEAVY = ("tensordict", "torchrl", "torch._dynamo", "ray", "scipy.optimize", "matplotlib", "hydra")


def loaded_after(code: str) -> set[str]:
    """The heavy modules that a fresh interpreter has imported after ``code``."""
    script = f"import sys\n{code}\nprint(*(name for name in {HEAVY} if name in sys.modules))"
    command = [sys.executable, "-c", script]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


@pytest.mark.parametrize(
    "code",
    [
        "import torch_qpmpc",
        "from torch_qpmpc import QPMPC, solve_qp",
        "import torch, torch_qpmpc as qm; mpc = qm.QPMPC(2, 1, 3); mpc.value(torch.ones(2))",
    ],
    ids=["import", "from import", "solve"],
)
def test_a_qp_alone_imports_nothing_heavy(code):
    assert loaded_after(code) == set()


@pytest.mark.slow
def test_torchrl_comes_with_the_names_that_need_it():
    assert "tensordict" in loaded_after("from torch_qpmpc import QPActorValueOperator")
    assert "torchrl" in loaded_after("import torch_qpmpc; torch_qpmpc.envs.PointMassEnv")


def test_every_public_name_is_there_and_listed():
    names = {*torch_qpmpc.__all__, "envs"}
    assert names <= set(dir(torch_qpmpc))
    for name in names:
        value = getattr(torch_qpmpc, name)
        assert value is vars(torch_qpmpc)[name], f"{name} is looked up twice"
    with pytest.raises(AttributeError, match="'torch_qpmpc' has no attribute 'QPMCP'"):
        torch_qpmpc.QPMCP  # noqa: B018 # pyright: ignore[reportAttributeAccessIssue] - misspelt


def test_gymnasium_has_the_ids_without_the_environments():
    registered = [name for name in gymnasium.registry if name.startswith("torch_qpmpc/")]
    assert registered == ["torch_qpmpc/PointMass-v0", "torch_qpmpc/GrosZanonLTI-v0"]
    code = "import gymnasium, torch_qpmpc; gymnasium.spec('torch_qpmpc/PointMass-v0')"
    assert loaded_after(code) == set()
    for name in registered:
        assert gymnasium.make(name).reset(seed=0)[0].shape
