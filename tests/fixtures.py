"""The fixtures of all tests; xdist's own process, which runs none, does not import them."""

import ctypes
import functools
import gc
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from matplotlib.figure import Figure

import train
from tests.runs import SMALL, make_config
from torch_qpmpc.control import exporting
from torch_qpmpc.export import comparison, library
from torch_qpmpc.identification import learned, subspace
from torch_qpmpc.mpc import stage_cost
from torch_qpmpc.qp.solvers import BACKENDS

#: Resolution of the tests' figures.
SMALL_DPI = 40
#: What an export's files say of its state, once a first compilation has measured it.
SIZE = re.compile(r"state has \S+ bytes")


def pytest_collection_finish() -> None:
    """Leave all that exists before the first test out of the collections of garbage; have few."""
    gc.freeze()
    gc.set_threshold(20_000, 20)
    gc.enable()


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Limit torch to one thread: test workers run in parallel.

    Set before every test, because TorchRL's ``check_env_specs`` changes the number.
    """
    torch.set_num_threads(1)


@pytest.fixture(params=[*BACKENDS, "qpsolvers:clarabel"])
def solver(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="session", autouse=True)
def quick_exports() -> Iterator[None]:
    """Compile exports without optimisation and once each, and compare them at few states."""
    compile_now = library.compiled

    @functools.lru_cache(maxsize=64)
    def once(command: tuple[str, ...], files: tuple[tuple[str, str], ...], flags: tuple[str, ...]):
        return compile_now(dict(files), flags)

    def compiled(files: Mapping[str, str], flags: Sequence[str]) -> ctypes.CDLL:
        texts = {file: SIZE.sub("state has some bytes", text) for file, text in files.items()}
        return once((*library.required_compiler(),), (*sorted(texts.items()),), (*flags,))

    with pytest.MonkeyPatch.context() as patch:
        for module in (exporting, library):
            patch.setattr(module, "FLAGS", ("-std=c99", "-O0", "-fPIC", "-shared"))
            patch.setattr(module, "compiled", compiled)
        patch.setattr(exporting, "COMPARED", 20)
        patch.setattr(comparison, "COMPARED", 40)
        yield


@pytest.fixture
def few_orders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try no orders far above those of the tests' plants."""
    monkeypatch.setattr(subspace, "ORDERS", (1, 2, 3, 4))


@pytest.fixture
def rough_fits(monkeypatch: pytest.MonkeyPatch, few_orders: None) -> None:
    """Fit models, networks and costs roughly: the tests of mpc compare the fits."""
    monkeypatch.setattr(learned, "STEPS", 200)
    monkeypatch.setattr(subspace, "LAGS", (2, 10))
    monkeypatch.setattr(subspace, "MANY", 8)
    monkeypatch.setattr(stage_cost, "ITERATIONS", 50)


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_disks() -> Iterator[None]:
    """Let writes return before the disk has them: no test cuts the power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="module", autouse=True)
def quick_figures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Draw small figures without their layout; modules that are marked ``layout`` keep both."""
    save = Figure.savefig

    def save_small(figure: Figure, *arguments: Any, **options: Any) -> None:
        save(figure, *arguments, **options | {"dpi": SMALL_DPI})

    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("layout") is None:
            patch.setattr(Figure, "get_layout_engine", lambda _: None)  # nor drawn twice for it
            patch.setattr(Figure, "savefig", save_small)
            patch.setitem(matplotlib.rcParams, "figure.dpi", SMALL_DPI)
        yield


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return a function that registers an environment for a test, and returns its id."""

    def add(
        make: Callable[..., Any], steps: int | None = None, name: str = "", **options: Any
    ) -> str:
        id = name or f"{make.__name__}-v0"
        spec = EnvSpec(id, lambda **more: make(**options | more), max_episode_steps=steps)
        monkeypatch.setitem(gymnasium.registry, id, spec)
        return id

    return add


@pytest.fixture
def fresh_dynamo() -> Iterator[None]:
    """Forget what torch.compile has compiled, before and after a test."""
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


@pytest.fixture
def two_threads(one_thread: None) -> None:
    """Let torch, and with it ProxQP, use two threads."""
    torch.set_num_threads(2)


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train two sweeps of small runs; seed 4 starts without a real gap."""
    folder = tmp_path_factory.mktemp("runs")
    runs = [("gaussian", "fixed", 1), *(("gaussian", "free", i) for i in (1, 4))]
    for noise, case, seed in (*runs, ("brownian", "free", 1)):
        settings = (f"constraint={case}", f"noise={noise}", f"seed={seed}", "task.eval_steps=20")
        place = folder / "small" / f"{noise}-{case}-seed{seed}"
        train.train(make_config(*SMALL, *settings), str(place), quiet=True)
    for c_2 in (0.0, 0.5):
        settings = (f"constraint.deviation.c_2={c_2}", "task.eval_steps=20")
        train.train(make_config(*SMALL, *settings), str(folder / "weights" / f"{c_2}"), quiet=True)
    return folder
