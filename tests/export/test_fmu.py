"""`export_fmu`: policies and controllers as FMUs, through their C interface and through FMPy."""

import ctypes
import runpy
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.examples import FOLDER
from torch_qpmpc.control.state_space import read_model
from torch_qpmpc.errors import QPError
from torch_qpmpc.export import library
from torch_qpmpc.export.fmu import Variable, write_fmu

WARNED = 2  # fmi3Discard
MODEL = ([[0.9, 0.05], [0.0, 0.8]], [[0.5], [0.2]], np.eye(2))


def controller(**options) -> qm.Controller:
    """Return a controller with names, units, forecasts, soft bounds and bounds of moves."""
    names: Any = {"inputs": ["q"], "outputs": ["T", "h"], "known": ["d", "price"]}
    plant = read_model(MODEL, E=[[0.1, 0.0], [0.0, 0.0]], **names)
    bounds = {"u_bounds": (0.0, 2.0), "du_bounds": (-0.7, 0.7), "y_bounds": {"T": (-1.0, 6.0)}}
    mpc = qm.LinearMPC(
        replace(plant, dt=60.0, units={"T": "degC", "q": "kW"}),
        8,
        Q={"T": 1.0},
        dR=0.1,
        linear={"q": "price"},
        **bounds,
        **options,
    )
    return qm.Controller(mpc)


class Component:
    """An FMU's library, unpacked and instantiated."""

    def __init__(self, path: Path, folder: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        self.xml = ElementTree.parse(folder / "modelDescription.xml").getroot()
        (binary,) = (folder / "binaries").glob("*/*")
        self.library = ctypes.CDLL(str(binary))
        self.places = {
            x.get("name"): (int(x.get("valueReference", 0)), x.tag)
            for x in self.xml.find("ModelVariables") or ()
        }
        made = self.library.fmi3InstantiateCoSimulation
        made.restype, token = ctypes.c_void_p, self.xml.get("instantiationToken", "").encode()
        flags = [ctypes.c_bool(False)] * 4
        nothing = (None, ctypes.c_size_t(0), None, None, None)
        assert made(b"one", b"another token", None, *flags, *nothing) is None
        self.pointer = ctypes.c_void_p(made(b"one", token, None, *flags, *nothing))
        time = ctypes.c_double(0.0)
        assert not self.library.fmi3EnterInitializationMode(self.pointer, False, time, time)

    def start(self) -> None:
        assert not self.library.fmi3ExitInitializationMode(self.pointer)

    def call(self, function: str, name: str, values: np.ndarray) -> int:
        place, count = ctypes.c_uint32(self.places[name][0]), ctypes.c_size_t(values.size)
        pointers = ctypes.byref(place), ctypes.c_size_t(1), ctypes.c_void_p(values.ctypes.data)
        return self.library["fmi3" + function](self.pointer, *pointers, count)

    def put(self, **values) -> None:
        for name, x in values.items():
            kind, dtype = ("Boolean", bool) if isinstance(x, bool) else ("Float64", float)
            values = np.atleast_1d(np.array(x, dtype))
            assert not self.call(f"Set{kind}", name.replace("__", "."), values), name

    def get(self, name: str, size: int = 1) -> np.ndarray:
        kind, dtype = ("Int64", np.int64) if name == "status" else ("Float64", float)
        values = np.zeros(size, dtype)
        assert not self.call(f"Get{kind}", name, values)
        return values

    def step(self, time: float, size: float) -> int:
        flags, reached = (ctypes.c_bool * 3)(), ctypes.c_double()
        own = [ctypes.byref(flags, i) for i in range(3)]
        made = ctypes.c_double(time), ctypes.c_double(size), ctypes.c_bool(True)
        return self.library.fmi3DoStep(self.pointer, *made, *own, ctypes.byref(reached))


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return controller().export_fmu(tmp_path_factory.mktemp("fmu") / "tank.fmu").files[0]


def test_a_closed_loop_of_200_steps_is_python_s_with_gaps_manual_mode_and_forecasts(path, tmp_path):
    fmu, own, rng = Component(path, tmp_path), controller(), np.random.default_rng(0)
    A, B, _ = map(np.array, MODEL)
    x, codes = np.array([2.0, 0.3]), set()
    fmu.start()
    for k in range(200):
        y, r = x + 0.01 * rng.normal(size=2), [3.0 * (k // 40 % 2) + 5.0 * (k > 150), 0.0]
        d, price = 1 + np.cumsum(0.05 * rng.normal(size=9)), 0.02 + 0.01 * rng.random(9)
        y[1] = np.nan if k % 17 == 5 else y[1]
        manual, held = 80 <= k < 90, k % 2 == 0
        ahead = np.where(held & (np.arange(9) > 3), np.nan, d)  # holds the stage before
        fmu.put(y__T=y[0], y__h=y[1], r__T=r[0], r__h=r[1], known__d=ahead, known__price=price)
        fmu.put(applied__q=0.4, manual=manual)
        at_once = fmu.get("u.q")
        assert not fmu.step(60.0 * k, 60.0)
        known = {"d": np.where(np.isnan(ahead), d[3], d), "price": price}
        if manual:
            own.observe(y, [0.4], known=known)
        else:
            own.step(y, r, known=known)
        assert fmu.get("status") == own.status
        assert at_once == fmu.get("u.q")
        assert np.allclose(fmu.get("u.q"), own.u, atol=1e-9, rtol=0)
        codes.add(own.status.name)
        x = A @ x + B @ own.u + [0.1 * d[0], 0.0]
    assert codes == {"SOLVED", "MISSING"}
    assert fmu.get("time") == 12000.0


def test_it_starts_at_rest_and_a_state_can_be_restored(path, tmp_path):
    fmu, own = Component(path, tmp_path), controller()
    signals = {"y__T": 5.0, "y__h": 1.0, "r__T": 4.0, "r__h": 0.0, "last__q": 0.8, "rests": True}
    known = {"d": 1.0, "price": 0.02}
    fmu.put(**signals, known__d=[1.0] * 9, known__price=[0.02] * 9)
    fmu.start()
    own.reset(y=[5.0, 1.0], u=[0.8], known=known)
    state = ctypes.c_void_p()
    for k in range(4):
        u = own.step([5.0, 1.0], [4.0, 0.0], known=known)
        if k == 2:
            assert not fmu.library.fmi3GetFMUState(fmu.pointer, ctypes.byref(state))
        assert not fmu.step(60.0 * k, 60.0)
        assert np.allclose(fmu.get("u.q"), u, atol=1e-9, rtol=0)
    last = fmu.get("u.q")
    assert not fmu.library.fmi3SetFMUState(fmu.pointer, state)
    assert not fmu.step(120.0, 120.0)  # two steps at once
    assert fmu.get("u.q") == last


def test_names_units_bounds_and_sources_are_in_it(path, tmp_path):
    fmu = Component(path, tmp_path)
    names = ["y.T", "y.h", "r.T", "known.d", "applied.q", "last.q", "u.q", "manual", "rests"]
    assert {*names, "time", "status"} <= {*fmu.places}
    units = {x.get("name"): x.get("unit") for x in fmu.xml.iter("Float64")}
    assert (units["y.T"], units["u.q"], units["y.h"]) == ("degC", "kW", None)
    assert (fmu.get("lower.q"), fmu.get("upper.q")) == (0.0, 2.0)
    assert (fmu.get("upper.T"), fmu.get("upper.h")) == (6.0, np.inf)
    assert {x.name for x in (tmp_path / "sources").iterdir()} >= {"policy.c", "policy_fmu.c"}
    assert (dt := fmu.xml.find("CoSimulation")) is not None
    assert dt.get("fixedInternalStepSize") == "60.0"


def test_wrong_steps_references_and_sizes_are_refused(path, tmp_path):
    fmu = Component(path, tmp_path)
    fmu.start()
    assert fmu.step(0.0, 90.0) == WARNED
    assert fmu.step(0.0, 1.0) == WARNED
    for function, name, size in (
        ("GetFloat64", "manual", 1),
        ("GetFloat64", "known.d", 8),
        ("SetFloat64", "u.q", 1),
        ("SetFloat64", "time", 1),
        ("SetBoolean", "u.q", 1),
        ("GetInt64", "u.q", 1),
        ("GetFloat32", "u.q", 1),
    ):
        assert fmu.call(function, name, np.zeros(size)) == 3, (function, name)


@pytest.mark.parametrize("n_d", [0, 2])
def test_a_policy_is_the_module_s(tmp_path, n_d):
    options = {"E": 0.1 * np.ones((2, n_d))} if n_d else {}
    weights = [1.0, 1.0, 0.1]
    A, B = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]]
    options |= {"action_bounds": ([-1.0], [1.0]), "solver": "daqp"}
    mpc = qm.QPMPC.from_model(A, B, 3, stage_weight=weights, **options)
    report = qm.export_fmu(mpc, tmp_path / "policy.fmu")
    fmu = Component(report.files[0], tmp_path / "unpacked")
    fmu.start()
    for p in np.random.default_rng(0).normal(size=(20, mpc.n_p)) * 3:
        fmu.put(x=p[-2:], **({"d": p[:-2]} if n_d else {}))
        assert not fmu.step(0.0, 1.0)
        s = torch.tensor(p)
        assert np.allclose(fmu.get("u"), mpc.policy(s).detach(), atol=1e-9, rtol=0)
        assert np.isclose(fmu.get("value"), mpc.value(s).item(), rtol=1e-9)
    assert (fmu.get("u.lower"), fmu.get("u.upper")) == (-1.0, 1.0)


def test_fmpy_finds_no_problem_and_runs_it(path):
    """FMPy checks the schema, too: pip install torch-qpmpc[fmu]."""
    fmpy = pytest.importorskip("fmpy")
    validation = pytest.importorskip("fmpy.validation")
    assert validation.validate_fmu(str(path)) == []
    start = {"r.T": 3.0, "y.T": 2.0, "y.h": 0.0}
    result = fmpy.simulate_fmu(str(path), stop_time=600.0, start_values=start, output=["u.q"])
    assert 0.0 < result["u.q"][-1] <= 2.0


def test_without_a_compiler_it_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(library, "compiler", lambda: None)
    with pytest.raises(QPError, match=r"^compiler: got none on the PATH, expected a C compiler"):
        controller().export_fmu(tmp_path / "tank.fmu")


#: A tank in C with the functions that ``fmu.c`` calls: its output follows the input with a lag.
TANK = {
    "tank.h": """#define TANK_N_P 1
#define TANK_N_U 1
typedef double tank_real;
typedef struct { double level; } tank_state;
typedef struct { double value; } tank_info;
void tank_reset(tank_state *s);
int tank_step(tank_state *s, const double p[], double u[], tank_info *info);
""",
    "tank.c": """#include "tank.h"
void tank_reset(tank_state *s) { s->level = 1; }
int tank_step(tank_state *s, const double p[], double u[], tank_info *info)
{
    u[0] = s->level;
    s->level = 0.9 * s->level + 0.5 * p[0] + 0.02;
    info->value = 0;
    return 0;
}
""",
}


def test_an_fmu_is_a_plant(tmp_path):
    """The example closes a loop with one, and a load that its log has not."""
    pytest.importorskip("fmpy")
    example = runpy.run_path(str(FOLDER / "fmu_plant.py"))
    variables = [Variable("q", "input", 0.0, ""), Variable("T", "output", 0.0, "")]
    variables.append(Variable("value", "output", 0.0, ""))
    path = write_fmu(tmp_path / "tank.fmu", "tank", TANK, variables, 2.0)
    names: Any = {"inputs": ["q"], "outputs": ["T"]}
    plant = example["Plant"](str(path), **names, dt=2.0)
    made, middle = example["controlled"](plant, names, 0.0, 2.0)
    run = made.simulate(plant, steps=60, r=middle + 1, load=0.1)
    assert np.allclose(run.y[-1], middle + 1, atol=1e-3)
