"""`Controller.export_c`: a controller as C, compared with Python in a closed loop."""

import ctypes
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch

from torch_qpmpc.control.design import largest
from torch_qpmpc.control.law import PLANNED, Law, Memory, Outcome, Signals
from torch_qpmpc.control.linear_mpc import LinearMPC
from torch_qpmpc.control.lowering import ROUNDS, SHRINKS, STAYS
from torch_qpmpc.control.observer import STEADY
from torch_qpmpc.control.simulation import centre, closed_loop, last_known
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.export import Export, build, check_name, refuse
from torch_qpmpc.export.fmu import Variable, write_fmu
from torch_qpmpc.export.library import FLAGS, compiled, compiler, required_compiler, written
from torch_qpmpc.export.tables import make_tables
from torch_qpmpc.export.writer import CONSTANTS, Settings, array, comment, filled, integers

#: Steps of the loop that is compared, and the most steps that the self-test replays.
COMPARED, REPLAYED = 200, 10
#: Largest difference of an input in the comparison, relative to half the distance of its bounds.
NEAR = {"float64": 1e-6, "float32": 1e-2}
SIZE = """#include "policy.h"
unsigned long policy_state_size(void) { return sizeof(policy_state); }
"""


@dataclass(frozen=True)
class ControllerExport:
    """Report of `Controller.export_c`: its ``files``, and the reports of ``plan`` and ``target``.

    ``table_bytes`` are all constant tables without self-tests; ``state_bytes`` and the largest
    ``difference`` of an input in a closed loop of ``steps`` are None without a compiler. With
    ``missing`` the covariance of the estimates is carried where outputs are missing.
    """

    files: tuple[Path, ...]
    plan: Export
    target: Export
    table_bytes: int
    state_bytes: int | None
    steps: int
    difference: float | None
    missing: bool = False

    def __str__(self) -> str:
        """Return a report of a few lines."""
        sizes = f"tables {self.table_bytes:,} bytes"
        sizes += "" if self.state_bytes is None else f", state {self.state_bytes:,} bytes"
        compared = "not compared: no C compiler was found"
        if self.difference is not None:
            compared = f"inputs of a closed loop of {self.steps} steps within {self.difference:.1e}"
        lines = [", ".join(map(str, self.files)), sizes, compared]
        lines += ["steps with or after missing outputs carry the covariance"] * self.missing
        return "\n".join(lines)


class Loop(NamedTuple):
    """Signals of a closed loop by step, from rest with the input ``start``, which is one row."""

    y: Array
    r: Array
    known: Array
    u: Array
    start: Array


class CompiledController:
    """The functions of an exported controller of n_u inputs, compiled from texts by file name."""

    def __init__(self, files: Mapping[str, str], name: str, dtype: str, n_u: int) -> None:
        size = SIZE.replace("policy", name)
        library = compiled({**files, "size_.c": size}, FLAGS)
        self._step, self._reset, self._observe = (
            library[f"{name}_{function}"] for function in ("step", "reset", "observe")
        )
        for function, pointers in ((self._step, 5), (self._reset, 4), (self._observe, 4)):
            function.argtypes = [ctypes.c_void_p] * pointers
        self.selftest = library[f"{name}_selftest"]
        state_size = library[f"{name}_state_size"]
        state_size.restype = ctypes.c_ulong
        self.state_bytes, self._dtype = int(state_size()), np.dtype(dtype)
        self._state, self._u = np.zeros(self.state_bytes, np.uint8), np.zeros(n_u, self._dtype)
        self.reset()

    def reset(self, y: Any = None, u: Any = None, known: Any = None) -> None:
        """Forget the past, as ``policy_reset``."""
        self._call(self._reset, y, u, known)

    def observe(self, y: Any, u: Any, known: Any = None) -> int:
        """Take note of an input that was applied, as ``policy_observe``; return its code."""
        return self._call(self._observe, y, u, known)

    def step(self, y: Any, r: Any = None, known: Any = None) -> tuple[Array, int]:
        """Return the input and the code of a step; r and known have all rows."""
        code = self._call(self._step, y, r, known, self._u)
        return self._u.astype(np.float64), code

    def policy(self, signals: Signals) -> Any:
        """Return the move of a step, with a NaN input if it has no plan."""
        u, code = self.step(*signals)
        return SimpleNamespace(u=np.where(code in PLANNED, u, np.nan), status=Outcome.SOLVED)

    def _call(self, function: Any, *signals: Any) -> int:
        numbers = [None if x is None else np.asarray(x, self._dtype, order="C") for x in signals]
        pointers = (None if x is None else x.ctypes.data for x in numbers)
        return int(function(self._state.ctypes.data, *pointers))


def export_controller(
    law: Law, memory: Memory, folder: str | Path, name: str, **options: Any
) -> ControllerExport:
    """Write a controller as C; see `Controller.export_c`."""
    report, texts = _build(law, memory, name, **options)
    return replace(report, files=written(folder, texts))


def export_controller_fmu(
    law: Law, memory: Memory, path: str | Path, name: str, **options: Any
) -> ControllerExport:
    """Write a controller as an FMU; see `Controller.export_fmu`."""
    required_compiler()
    report, texts = _build(law, memory, name, missing=True, **options)
    file = write_fmu(path, name, texts, _variables(law, memory), law.design.plant.dt or 1.0)
    return replace(report, files=(file,))


def _build(
    law: Law, memory: Memory, name: str, missing: bool = False, **options: Any
) -> tuple[ControllerExport, dict[str, str]]:
    """Return a report without files, and the texts by file name."""
    law.design.plant.check_linear("C and FMUs")  # a copy of a plan does not know
    check_name(name)
    mpc, settings = law.mpc, Settings(f"{name}_plan", **options)
    dtype = settings.dtype
    plan, texts, _ = build(mpc.plan, settings)
    target, own, _ = build(mpc.targets, settings._replace(name=f"{name}_target"))
    texts |= own
    course = _course(law, last_known(law.design, memory))
    start = course["u"]
    loop = _run(law, course, law.policy(law.begun(start)), COMPARED)
    texts |= _sources(law, name, dtype, loop, missing)
    state_bytes = difference = None
    if compiler() is not None:
        library = CompiledController(texts, name, dtype, len(start))
        library.reset(u=start)
        state_bytes, steps = library.state_bytes, len(loop.u)
        own = _run(law, course, library.policy, steps)
        difference = np.abs(own.u[:steps] - loop.u[: len(own.u)]).max(0)
        got = f"a failed self-test ({failed})" if (failed := library.selftest()) else ""
        if (lost := np.isnan(own.u).any(1)).any():
            got = f"no plan of C's in step {lost.argmax()} of a loop, where Python has one"
        elif len(own.u) < steps or (difference > NEAR[dtype] * mpc.design.scaling.u).any():
            got = f"inputs of a loop off by {difference}"
        if got:
            refuse(dtype, got, plan)
    texts[f"{name}.h"] = texts[f"{name}.h"].replace("@BYTES@", f"{state_bytes or 'some'}")
    own = sum(x.size for x in _tables(law, dtype, missing).values()) * np.dtype(dtype).itemsize
    own += plan.table_bytes + target.table_bytes
    most = None if difference is None else float(difference.max())
    parts = plan, target, own, state_bytes, len(loop.u), most, missing
    return ControllerExport((), *parts), texts


def _variables(law: Law, memory: Memory) -> list[Variable]:
    """Return the variables of a controller's FMU, in the order of ``fmu.c``."""
    design, plant = law.design, law.design.plant
    outputs, inputs, stages = plant.outputs, plant.inputs, design.horizon + 1
    aims = stages if design.references == "preview" else 0
    known, held = last_known(design, memory), np.full(stages, np.nan)
    r = memory.r[-1] if len(memory.r) else centre(design, known)
    kinds = [
        ("y.", "input", outputs, [np.nan] * len(outputs), 0, "measured; NaN if missing"),
        ("r.", "input", outputs, r, aims, "set-point"),
        ("known.", "input", plant.known, known, stages, "known, by stage"),
        ("applied.", "input", inputs, memory.u, 0, "applied in manual mode"),
        ("last.", "parameter", inputs, memory.u, 0, "applied before the start"),
        ("u.", "output", inputs, memory.u, 0, "input of the plant"),
    ]
    for names, bounds in ((outputs, design.y_bounds), (inputs, design.u_bounds)):
        sides = zip(("lower.", "upper."), bounds, strict=True)
        kinds += [(side, "constant", names, limits, 0, "bound") for side, limits in sides]
    variables = []
    for prefix, causality, names, values, rows, about in kinds:
        for name, value in zip(names, values, strict=True):
            start = np.append(value, held[1:]) if rows else value  # a NaN holds the stage before
            unit = plant.units.get(name)
            variables.append(Variable(prefix + name, causality, start, about, unit))
    rests = memory.rest[0] is not None, "at the start the plant rests with y and last"
    manual = False, "take note of the applied inputs, in place of a step"
    variables.append(Variable("manual", "input", *manual))
    return [*variables, Variable("rests", "parameter", *rests)]


def _course(law: Law, known: Array) -> dict[str, Any]:
    """Return arguments of a loop with noise, a load and moving set-points.

    It starts at rest near `centre`, with the input ``u``.
    """
    rng, design = np.random.default_rng(0), law.design
    rows = COMPARED + design.horizon + 1
    size_y, size_u = design.usual, design.scaling.u
    moves = rng.uniform(-1, 1, (-(-rows // 25), len(size_y))).repeat(25, 0)[:rows]
    r = centre(design, known)
    x, u, *_ = map(torch.Tensor.numpy, law.mpc.target(r, known=known))  # as near as bounds allow
    moved = 0.1 * design.scaling.d * rng.normal(size=(rows, len(known)))
    for of in design.limited:  # bounds are wider than at rest, so that there is a plan
        for places, sign in zip(of, (-1, 1), strict=True):
            moved[:, places[places >= 0]] = sign * np.abs(moved[:, places[places >= 0]])
    disturbed = {"load": 0.05 * size_u, "noise": 0.01 * size_y}
    return {"r": r + moves * size_y, "u": u, "x": x, "known": known + moved, **disturbed}


def _run(law: Law, course: dict[str, Any], act: Any, steps: int) -> Loop:
    """Return the loop of a policy with the law's model, while there are plans for its outputs.

    Each policy closes a loop of its own: replaying outputs through an unstable controller would
    measure rounding alone.
    """
    rows, stages = [], slice(None if law.design.references == "preview" else 1)
    loop = closed_loop(law, Memory(course["u"]), None, steps, act=act, **course)
    try:
        for (y, r, known), move, _ in loop:
            rows.append((y, r[stages], known, move.u))
    except (QPError, SolverError) as error:  # no plan, or outputs above `Law.max_plausible`
        if not rows:
            levels = "add levels, shorten min_on or min_off, " * bool(law.design.levels)
            remedy = f"widen them, {levels}or give the outputs a y_slack"
            raise SolverError(f"No input keeps the hard bounds from rest: {remedy}.") from error
    y, r, known, u = map(np.array, zip(*rows, strict=True))
    return Loop(y, r, known, u, course["u"][None])


def _replayed(law: Law, loop: Loop, dtype: str) -> Loop:
    """Return the first steps of a loop, while rounded outputs give nearly the same inputs.

    A controller that is unstable on its own enlarges rounding as its inputs move no plant here.
    """
    rounding = 1e-4 * NEAR[dtype] * np.random.default_rng(0).choice([-1, 1], loop.y.shape)
    near = 0.01 * NEAR[dtype] * law.design.scaling.u
    policy = law.policy(law.begun(loop.start[0]))
    for k, (y, r, known, u) in enumerate(zip(*loop[:4], strict=True)):
        move = policy(Signals(y * (1 + rounding[k]), r, known))
        # At the edge of hard bounds there may be no plan.
        far = k and (move.status or (np.abs(move.u - u) > near).any())
        if far or k == REPLAYED or move.status == Outcome.NODE_LIMIT:
            return Loop(loop.y[:k], loop.r[:k], loop.known[:k], loop.u[:k], loop.start)
    return loop


def _sources(law: Law, name: str, dtype: str, loop: Loop, missing: bool) -> dict[str, str]:
    """Return the texts of ``name.h`` and ``name.c``."""
    design, plant = law.design, law.design.plant
    every = "" if plant.dt is None else f", a step every {plant.dt:g}"
    header = [f"{name}: a linear MPC with an observer, by torch_qpmpc{every}."]
    header += ["Its state has @BYTES@ bytes."]
    groups = {"y and r": plant.outputs, "known": plant.known, "u": plant.inputs}
    header += [f"{k}: {', '.join(map(plant.label, x))}" for k, x in groups.items() if x]
    sizes = {f"{name.upper()}_{key}": size for key, size in _sizes(law).items()}
    sizes[f"{name.upper()}_CARRIES"] = int(missing)
    defined = "\n".join(f"#define {key} {size}" for key, size in sizes.items())
    tables = [array(key, x, dtype) for key, x in _tables(law, dtype, missing).items()]
    names = "OF_R", "OF_Y", "OF_U", "LOWER_OF", "UPPER_OF"
    places = design.weighted, *design.bounded, *design.limited[1]
    tables += map(integers, names, places)
    replayed = _replayed(law, loop, dtype)
    examples = {
        f"EXAMPLE_{key.upper()}": x.reshape(len(x), math.prod(x.shape[1:]))
        for key, x in replayed._asdict().items()
    }
    examples["NEAR_U"] = NEAR[dtype] * design.scaling.u
    shown = [f"#define EXAMPLES {len(replayed.u)}"]
    shown += [array(key, x, dtype) for key, x in examples.items()]
    parts = {
        "/* @HEADER@ */": comment(header),
        "/* @SIZES@ */": defined,
        "/* @TABLES@ */": "\n".join([f"#define BIG {CONSTANTS[dtype]['BIG']}", *tables]),
        "/* @EXAMPLES@ */": "\n".join(shown),
    }
    return {f"{name}.{end}": filled(f"controller.{end}", name, parts) for end in "hc"}


def _sizes(law: Law) -> dict[str, int]:
    (n, m, n_y, n_d), design, observer = law.design.plant.sizes, law.design, law.observer
    width = {key: place.stop - place.start for key, place in design.places.items()}
    stages, n_e, levels = design.horizon + 1, len(observer.F), law.mpc.plan.levels
    of = {"N_R": "r", "N_UR": "u_r", "OFF": "off", "MOVES": "u_last", "ENDS": "end"}
    of |= {"BOUNDED_Y": "y_s", "BOUNDED_U": "u_s"}
    sizes = {"N_X": n, "N_W": n_e - n, "N_E": n_e, "N_U": m, "N_Y": n_y, "N_D": n_d}
    sizes |= {"N_D_": max(n_d, 1), "GAINS": len(observer.gains), "STAGES": stages}
    sizes |= {"N_F": design.steady.anchors, "ROUNDS": ROUNDS}
    sizes |= {"SET_POINTS": stages if design.references == "preview" else 1}
    sizes |= {"WEIGHTED": len(design.weighted)}
    sizes |= {"LEVELS": levels.values.shape[1] if levels else 0}
    sizes |= {"RUNS": max(levels.rules.sum(1)) if levels else 0}
    return sizes | {key: width[name] for key, name in of.items()}


def _tables(law: Law, dtype: str, missing: bool) -> dict[str, Array]:
    """Return the constant arrays by their names in C; ``missing`` outputs take more of them."""
    design, steady, observer = law.design, law.design.steady, law.observer
    if levels := law.mpc.plan.levels:
        on_levels = np.full((len(design.R), levels.values.shape[1]), np.inf)
        on_levels[levels.actions] = levels.values
    own = observer._asdict() | {"gains": observer.gains.reshape(len(observer.gains), -1)}
    S, first, LS = own.pop("S"), own.pop("P"), observer.L @ observer.S
    if missing:
        own |= {"S": S, "FIRST": first, "LS": LS, "LSL": LS @ observer.L.T}
        own |= {"OF_S": np.sqrt(np.diag(S)), "STEADY": np.array([STEADY])}
    if design.pulls[1].size:  # the maps of `Design.end_set_points`
        (moved, shifts), tables = design.pulls, make_tables(law.mpc.targets)
        n_g = len(law.mpc.targets.quadratic_program().lb)
        shifts = np.pad(shifts, ((0, 0), (n_g - shifts.shape[1], 0)))[:, tables.places]
        own |= {"moved": moved, "shifts": shifts / tables.rows.unit, "Q": design.Q}
    return {
        **{key.upper(): x for key, x in own.items()},
        **{f"{key}_V": getattr(steady, key) for key in "XUY"},
        **{f"{key.upper()}_L": getattr(steady, key) for key in "xuy"},
        "ACTS": design.acts.astype(float),
        "NOMINAL": design.nominal,
        "U_LOWER": design.u_bounds[0],
        "U_UPPER": design.u_bounds[1],
        **dict(zip(("MOVE_LOWER", "MOVE_UPPER"), _moves(law.mpc, dtype), strict=True)),
        **dict(zip(("MOST_Y", "MOST_KNOWN"), law.max_plausible, strict=True)),
        "MOST_U": law.max_plausible_u,
        "SHRINKS": np.array([SHRINKS]),
        "STAYS": np.array([max(STAYS, 100 * np.finfo(dtype).eps)]),
        **({"INPUT_LEVELS": on_levels, "SWITCH": law.switches} if levels else {}),
    }


def _moves(mpc: LinearMPC, dtype: str) -> Array:
    """Return the plan's bounds of the first move, ``(2, m)``, with room for rounding."""
    design, bands, qp = mpc.design, mpc.design.bands, mpc.plan.quadratic_program()
    bounds = np.outer([-np.inf, np.inf], np.ones(len(design.R)))
    own = np.asarray(bands.D.any(1))
    first = len(qp.lb) - len(design.ends.W) - mpc.horizon * len(own)
    sides = (side[first:][: len(own)].detach().double().cpu().numpy() for side in (qp.lb, qp.ub))
    bounds[:, np.nonzero(bands.D)[1]] = [side[own] for side in sides]
    size = largest(bounds)
    size = np.where(size > 0, size, design.scaling.u)
    room = NEAR[dtype] * size + 4 * np.finfo(dtype).eps * largest(design.u_bounds)
    return bounds + np.array([[-1], [1]]) * room
