"""`import torch_qpmpc`: what it imports, and the names that it imports only when they are used."""

import importlib.util
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


def test_a_qp_a_controller_and_the_id_import_nothing_heavy():
    code = (
        "import gymnasium, torch, torch_qpmpc\n"
        "from torch_qpmpc import QPMPC, solve_qp\n"
        "gymnasium.spec('torch_qpmpc/PointMass-v0')\n"
        "QPMPC.from_model([[1]], [[1]], 3, stage_weight=[1, 1]).value(torch.ones(1))\n"
        "mpc = torch_qpmpc.LinearMPC(([[0.9]], [[0.5]]), 3, Q=1.0)\n"
        "torch_qpmpc.Controller(mpc).step([0.0], [1.0])"
    )
    assert loaded_after(code) == set()
    spelt = {name for name in HEAVY if importlib.util.find_spec(name)}
    assert spelt >= {*HEAVY} - {"ray"}, "ray is an extra"


def test_every_public_name_is_there_and_listed():
    names = {*torch_qpmpc.__all__, "envs"}
    assert {*dir(torch_qpmpc)} == names | {"__version__"}
    for name in names:
        value = getattr(torch_qpmpc, name)
        assert value is vars(torch_qpmpc)[name], f"{name} is looked up twice"
    with pytest.raises(AttributeError, match="'torch_qpmpc' has no attribute 'QPMCP'"):
        torch_qpmpc.QPMCP  # noqa: B018 # pyright: ignore[reportAttributeAccessIssue] - misspelt


def test_gymnasium_has_the_id():
    registered = [name for name in gymnasium.registry if name.startswith("torch_qpmpc/")]
    assert registered == ["torch_qpmpc/PointMass-v0"]


def test_errors_are_caught_as_the_builtin_ones():
    assert issubclass(torch_qpmpc.QPError, ValueError)
    assert issubclass(torch_qpmpc.SolverError, RuntimeError)
