"""Quadratic programs as value functions, learned by Q-learning and readable as linear MPC."""

import ast
import pkgutil
from pathlib import Path
from typing import Any

import gymnasium

__version__ = "0.1.0"

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
#: The module of each name of the stub, imported at its first use: Numba, TensorDict and TorchRL
#: take as long to import as torch does.
_LAZY = {
    x.name: own.module for own in _STUB.body if isinstance(own, ast.ImportFrom) for x in own.names
}
__all__ = [name for name in _LAZY if name != "envs"]  # pyright: ignore[reportUnsupportedDunderAll] - the stub has them


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place = "torch_qpmpc.envs:" if name == "envs" else f"{_LAZY[name]}:{name}"
    globals()[name] = pkgutil.resolve_name(place)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*_LAZY, "__version__"})


# Registering an id twice warns, and a reload or a spawned worker imports this again.
if "torch_qpmpc/PointMass-v0" not in gymnasium.registry:
    gymnasium.register(
        id="torch_qpmpc/PointMass-v0",
        entry_point="torch_qpmpc.envs.point_mass:PointMassGymEnv",
        max_episode_steps=50,
    )
