"""Schemes of every kind for the export as C, random QPs, and C compilers."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from tests.benchmarks.problems import PAPER, Size, make_mpc
from torch_qpmpc import QPMPC, QuadraticProgram
from torch_qpmpc.export.export import AT_LEAST, PER_ROW
from torch_qpmpc.export.library import Library
from torch_qpmpc.export.tables import Tables, make_tables
from torch_qpmpc.export.writer import Examples, Settings, sources

DRIVER = Path(__file__).parent / "export" / "driver.c"
STRICT = ("-Wall", "-Wextra", "-Wshadow", "-Wconversion", "-Werror", "-pedantic")


def house(horizon: int = 8) -> QPMPC:
    """Make a room heated by price, with a comfort band in the preview, soft at the price's size."""
    weight = torch.zeros(5, 5).double()
    weight[0, 4] = weight[4, 0] = 0.25
    weight[4, 4] = 2e-5
    D = torch.tensor([[0.0, -1.0, 0.0, 1.0, 0.0], [0.0, 0.0, -1.0, 1.0, 0.0]])
    sides = [0.0, -torch.inf], [torch.inf, 0.0]
    return QPMPC.from_model(
        [[0.88]],
        [[0.16]],
        horizon,
        E=[[0.0, 0.0, 0.0]],
        offset=[1.0],
        gamma=1.0,
        hessian="block",
        stage_weight=weight,
        terminal_weight=[[0.0]],
        action_bounds=([0.0], [12.0]),
        constraints=(D, *sides),
        terminal_constraints=(D[:, :4], *sides),
        constraint_slack=0.25,
        solver="daqp",
    )


def tied(horizon: int = 8, **options: Any) -> QPMPC:
    return QPMPC.from_model(
        torch.tensor([[1.0, 0.2], [-0.1, 0.95]]),
        torch.tensor([[0.0], [0.2]]),
        horizon,
        structure="tied",
        hessian="block",
        discount_slack=True,
        action_bounds=([-1.0], [1.0]),
        state_bounds=([-2.0, -1.0], [2.0, 1.0]),
        constraints=([[1.0, 0.5, 1.0], [0.0, 1.0, -1.0]], [-0.8, -torch.inf], [0.8, 0.6]),
        terminal_constraints=([[1.0, 1.0]], [-0.4], [0.3]),
        **{"stage_weight": [1.0, 1.0, 1.0], "solver": "daqp"} | options,
    )


def rates(horizon: int = 6) -> QPMPC:
    """Make a scheme with the last action as a state, and hard limits of the actions' changes."""
    return QPMPC.from_model(
        [[0.9, 0.1, 0.05], [0.0, 0.8, 0.1], [0.0, 0.0, 0.0]],
        [[0.1], [0.3], [1.0]],
        horizon,
        stage_weight=[1.0, 1.0, 0.0, 0.1],
        action_bounds=([-1.0], [1.0]),
        constraints=([[0.0, 0.0, -1.0, 1.0]], [-0.2], [0.2]),
        constraint_slack=torch.inf,
        state_bounds=([-1.0, -1.0, -torch.inf], [1.0, 1.0, torch.inf]),
        solver="daqp",
    )


SCHEMES: dict[str, Callable[[], QPMPC]] = {
    "point mass": lambda: make_mpc(PAPER, dense=False),
    "dense C": lambda: make_mpc(PAPER, dense=True),
    "12 states": lambda: make_mpc(Size(4, 12, 4), dense=False),
    "house": house,
    "tied": tied,
    "hard states": lambda: tied(4, state_slack=torch.inf),
    "rates": rates,
}


def random_qp(seed: int) -> Any:
    """Draw a QP in place of a QPMPC, with rows of every kind: equal bounds, w = 0, dependent, ..

    Its C may have dependent rows, which may restrict p, and its H may be indefinite in p.
    """
    rng = np.random.default_rng(seed)
    n_p, n_u = (int(rng.integers(1, high)) for high in (5, 3))
    n_c, r = (int(rng.integers(0, high)) for high in (5, 14))
    n_z = n_p + n_c + int(rng.integers(n_u, 8))
    factor = rng.standard_normal((n_z, n_z))
    H = factor @ factor.T / n_z + 0.05 * np.eye(n_z)
    if rng.random() < 0.5:
        on_p = np.zeros((n_z, n_z))
        on_p[:n_p] = rng.standard_normal((n_p, n_z))
        H = H + on_p + on_p.T
    C, b = rng.standard_normal((n_c, n_z)), rng.standard_normal(n_c)
    if n_c > 1 and rng.random() < 0.3:
        C[-1], b[-1] = 2 * C[0], 2 * b[0]
        if rng.random() < 0.3:
            C[-1, 0] += 1.0
    G, w = rng.standard_normal((r, n_z)), 10 ** rng.uniform(-1, 2, r)
    lb, ub = -rng.uniform(0, 2, r), rng.uniform(0, 2, r)
    w[rng.random(r) < rng.choice([0, 0.2, 0.5])] = np.inf
    for i, kind in enumerate(rng.integers(0, 9, r)):
        if kind == 0:
            lb[i] = -np.inf
        elif kind == 1:
            ub[i] = np.inf
        elif kind == 2:
            lb[i] = ub[i]
        elif kind == 3:
            w[i] = 0
        elif kind == 4 and i:
            G[i] = G[i - 1] * rng.choice([1, -1, 2.5])
        elif kind == 5 and i > 1:
            G[i] = G[i - 1] + G[i - 2]
        elif kind == 6:
            G[i, n_p:] = 0
        elif kind == 7:
            G[i] = 0
            G[i, n_p + rng.integers(0, n_u)] = 1
    theta = (H, rng.standard_normal(n_z), rng.standard_normal(), C, b, G, lb, ub, w)
    tensors = (torch.as_tensor(x, dtype=torch.float64) for x in theta)
    qp = QuadraticProgram(*tensors, check_values=False)
    parts = {"n_p": n_p, "n_u": n_u, "sequential": None, "levels": None}
    scheme = SimpleNamespace(constants={})
    return SimpleNamespace(quadratic_program=lambda: qp, scheme=scheme, **parts)


def draw_known(mpc: Any, count: int, seed: int = 0) -> np.ndarray:
    """Draw p of sizes from a hundredth to thirty."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((count, mpc.n_p)) * 10 ** rng.uniform(-2, 1.5, (count, 1))


def load(mpc: Any, flags: tuple[str, ...] = ("-O0",), **settings: Any) -> tuple[Library, Tables]:
    tables = make_tables(mpc)
    limit = PER_ROW * len(tables.Q) + AT_LEAST
    chosen = Settings("policy", "float64", limit)._replace(**settings)
    p, u, none = np.zeros((1, tables.n_p)), np.zeros((1, tables.n_u)), np.zeros(1)
    nothing = Examples(["origin"], p, np.zeros(1, int), u, none, none, none, u[0])
    texts, flags = sources(tables, chosen, "", nothing), (*flags, "-std=c99", "-fPIC", "-shared")
    return Library(texts, "policy", chosen.dtype, flags), tables


def read(folder: Path, name: str = "policy", dtype: str = "float64") -> Library:
    texts = {f"{name}.{end}": (folder / f"{name}.{end}").read_text() for end in "hc"}
    return Library(texts, name, dtype)


def compilers() -> dict[str, list[str]]:
    """Return the commands of the compilers that are installed, and compile and run a program."""
    commands = {
        "gcc": ["gcc", "-std=c99"],
        "clang": ["clang", "-std=c99"],
        "g++": ["g++", "-std=c++11", "-x", "c++"],
        "clang++": ["clang++", "-std=c++11", "-x", "c++"],
        "gcc -m32": ["gcc", "-m32", "-std=c99"],
    }
    return {name: command for name, command in commands.items() if _works(command)}


def _works(command: list[str]) -> bool:
    if shutil.which(command[0]) is None:
        return False
    program = "int main(void) { return 0; }"
    return not subprocess.run(
        [*command, "-x", "c++" if "++" in command[0] else "c", "-", "-o", "/dev/null"],
        input=program,
        capture_output=True,
        text=True,
        check=False,
    ).returncode
