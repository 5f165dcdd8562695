"""`Controller.review`: what is wrong with a design, with numbers and a remedy for each fault."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy  # imports scipy.optimize at its first use: a third of a second
import torch

from torch_qpmpc.control.design import Design, middle
from torch_qpmpc.control.disturbance import TINY, unseen_modes
from torch_qpmpc.control.exporting import WEIGHT, undetermined
from torch_qpmpc.control.law import Law, Memory
from torch_qpmpc.control.linear_loop import LinearLoop
from torch_qpmpc.control.linear_mpc import LinearMPC, Target
from torch_qpmpc.control.lowering import riccati
from torch_qpmpc.control.observer import kalman
from torch_qpmpc.control.simulation import at_rest, centre, last_known, simulate
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.tables import SINGULAR, Tables, make_tables
from torch_qpmpc.qp.pipeline.condensing import null_space
from torch_qpmpc.qp.program import Status
from torch_qpmpc.qp.solve import solve_qp

#: A number beyond these is a fault. A modulus margin of 0.5 is the usual aim.
MARGIN, CONDITION, HIDDEN = 0.3, 1e8, 1e-3
#: The most that a loop may cost under the log's noise, relative to a constant input.
NOISY = 1.1
#: An output's weight with a smaller share of the cost does not matter; one that does.
IDLE, NOTED = 1e-6, 1e-2
#: Steps of the loop that shows the shares, and of each of its set-points, which are these shares
#: of the outputs' sizes from the middle; and its load, relative to the inputs' sizes.
PROBED, HELD, MOVE, LOAD = 100, 25, 0.5, 0.1
#: Offsets relative to half the distance of an output's bounds.
OFFSET = 1e-6
#: The most times that a set-point is replaced by its nearest one, which soft bounds may move again.
SETTLES = 100
#: A response below this share of those soon after, with inputs of half their range, is noise.
SHOWS = 0.03
#: The most powers of ten that the filter is slowed down by, and the most times that the loop may
#: take as long to settle then as it does now, or as the horizon.
SLOWEST, PATIENCE = 8, 10
#: The remedy where no slower filter is one.
DAMP = "Raise dR tenfold."
#: Largest distance of outputs from the set-point that hard bounds are tried at, in half ranges.
LARGEST = 2.0


@dataclass(frozen=True)
class Finding:
    """One question to a design.

    Attributes:
        name: the subject, such as ``"stability"``.
        ok: False if it is a fault.
        numbers: the answer, by name.
        remedy: what mends the fault; empty if it is none.
    """

    name: str
    ok: bool
    numbers: Mapping[str, Any]
    remedy: str = ""

    @property
    def text(self) -> str:
        """The numbers in words."""
        return "; ".join(f"{key} {_number(x)}" for key, x in self.numbers.items())


@dataclass(frozen=True)
class Review:
    """The findings about a controller; ``print`` shows them.

    Attributes:
        findings: all of them; those that need a definite cost or a stable loop only with one.
    """

    findings: list[Finding] = field(default_factory=list)

    @property
    def faults(self) -> list[Finding]:
        """The findings that are not ok."""
        return [finding for finding in self.findings if not finding.ok]

    def __getitem__(self, name: str) -> Finding:
        return {finding.name: finding for finding in self.findings}[name]

    def __str__(self) -> str:
        lines = [f"{len(self.faults)} faults in {len(self.findings)} findings"]
        for finding in self.findings:
            lines.append(f"{'ok   ' if finding.ok else 'FAULT'} {finding.name}: {finding.text}")
            lines += [f"      {finding.remedy}"] * (not finding.ok)
        return "\n".join(lines)


def review(law: Law, memory: Memory, r: Any = None, known: Any = None) -> Review:
    """Return the findings about a controller; see `Controller.review`."""
    mpc, design, r_last = law.mpc, law.design, memory.r
    if r is not None:
        r_last = law.read_set_points(r, 1, memory.r)
    assumed = known is None and memory.known is None
    known = last_known(design, memory) if known is None else law.read_known(known, 1)[0]
    cost = _cost(mpc)
    findings = [
        cost,
        _terminal(design),
        _gains(design),
        _horizon(design),
        _disturbances(design),
        _hard_rows(mpc, r_last, known),
        _set_points(Setting(mpc, law.estimates(memory)[1], known), r_last, assumed),
    ]
    if not cost.ok:
        return Review(findings)
    plan, target = make_tables(mpc.plan), make_tables(mpc.targets)
    qps = [plan, target, *([] if mpc.free is None else [make_tables(mpc.free)])]
    loop = LinearLoop.of(mpc, law.observer, plan, target)
    findings.append(_condition(design, *cost.numbers.values()))
    findings.append(_stability(loop, design.gamma))
    if loop.radius < 1:
        findings += [_margin(loop, law, plan, target), _offset(loop, design)]
        if design.plant.noise is not None:
            findings.append(_noise(loop, law, plan, target, design.plant.noise))
    sizes: dict[str, Any] = {"rows": sum(len(x.rows) for x in qps)}
    findings.append(_weights(law, known))
    if names := undetermined(mpc):
        sizes["outputs whose bounds export_c refuses"] = names
    findings.append(Finding("C code", not names, sizes, WEIGHT.format(names) * bool(names)))
    return Review(findings)


def _cost(mpc: LinearMPC) -> Finding:
    """H is positive definite on the plans that satisfy C z = b, in signals divided by sizes."""
    qp, design = mpc.plan.quadratic_program(), mpc.design
    y, u, x, _ = design.scaling
    state = (x, u[: len(u) * design.moves], y[design.bounded[0]], u[design.bounded[1]], [1.0])
    later = np.tile(np.concatenate((u, *state)), mpc.horizon)
    units = np.concatenate((np.ones(mpc.plan.n_p), later))
    H, C = (x.detach().double().numpy() * units for x in (qp.H, qp.C))
    C = C / np.maximum(np.abs(C).max(1, keepdims=True, initial=0.0), TINY)
    T_v = null_space(C[None], mpc.plan.n_p).T[0][:, mpc.plan.n_p :]
    H = units[:, None] * H
    sizes = np.linalg.eigvalsh(T_v.T @ (H + H.T) @ T_v / 2)
    numbers = {"smallest eigenvalue on the plan": sizes[0], "largest": sizes[-1]}
    ok = bool(sizes[0] > SINGULAR * sizes[-1])
    remedy = _weighted(design, sizes[-1])
    if sizes[0] < -SINGULAR * abs(sizes[-1]):
        remedy = (
            "Learning has made it indefinite: mpc.plan.reset_parameters(), or learn other parts."
        )
    return Finding("cost", ok, numbers, remedy * (not ok))


def _weighted(design: Design, largest: float) -> str:
    least = [f"{1e-3 * largest / u**2:.1g}" for u in design.scaling.u]
    named = ", ".join(f"{u!r}: {x}" for u, x in zip(design.plant.inputs, least, strict=True))
    alike = len({*least}) == 1
    return f"Raise the weights of the inputs to R={least[0] if alike else f'{{{named}}}'}."


def _terminal(design: Design) -> Finding:
    """The terminal weight is the cost to go of the loop without bounds."""
    plant, exists = design.normal.plant, riccati(design) is not None
    unseen = unseen_modes(plant.A, design.normal.Q @ plant.C)
    unmoved = unseen_modes(plant.A.T, plant.B.T)
    numbers: dict[str, Any] = {"Riccati solution": "exists" if exists else "none"}
    remedy = "Weight all inputs, by R or dR."
    if len(unseen):
        numbers["mode without a weight"] = abs(unseen[0][0])
        remedy = "Weight an output that shows this mode, by Q."
    elif len(design.steady.W) and not design.R.any():
        remedy = "Weight all inputs by R: several of them hold the same outputs."
    elif len(unmoved):
        numbers["mode that no input moves"] = abs(unmoved[0][0])
        remedy = "Remove the mode from the model, or pass it as a known signal."
    return Finding("terminal weight", exists, numbers, remedy * (not exists))


def _gains(design: Design) -> Finding:
    """Each output's gains by inputs and known signals, to compare with the plant's."""
    plant, N = design.plant, design.horizon
    acting = plant.E.any(0)
    names = (*plant.inputs, *np.array(plant.known)[acting])
    A, B = plant.A, np.hstack((plant.B, plant.E[:, acting]))
    steady = np.abs(np.linalg.eigvals(A)).max() < 1 - 1e-9
    powers = (np.linalg.matrix_power(A, k) for k in range(N))
    x = np.linalg.solve(np.eye(len(A)) - A, B) if steady else sum(powers) @ B
    when = "in steady state" if steady else f"after {N} steps"
    numbers = {
        f"{y} per unit of {', '.join(names)} {when}": row
        for y, row in zip(plant.outputs, plant.C @ x, strict=True)
    }
    return Finding("gains", True, numbers)


def _horizon(design: Design) -> Finding:
    """The plan is longer than dead times and inverse responses."""
    plant, N, numbers, needed = design.plant, design.horizon, {}, 1
    stable = np.abs(np.linalg.eigvals(plant.A)).max() < 1 + 1e-9
    x, steps = plant.B * design.scaling.u, []
    for _ in range(max(10 * N, 200)):
        steps.append(plant.C @ x)
        x = plant.A @ x
    responses = np.cumsum(steps, 0)
    moves = np.abs(steps)  # beside the next ten steps', as a ramp has no largest one
    ahead = np.lib.stride_tricks.sliding_window_view(moves.max(2), 10, axis=0).max(-1)
    responses = responses[: len(ahead)]
    away = np.logical_and.accumulate(moves[: len(ahead)] <= SHOWS * ahead[..., None])
    if stable:
        away |= np.sign(responses) != np.sign(responses[-1])
    for i in np.flatnonzero(np.diag(design.Q)):
        first = 1 + min(int(np.flatnonzero([True, *x])[-1]) for x in away[:, i].T)
        numbers[f"steps until {plant.outputs[i]} responds in its direction"] = first
        needed = max(needed, first)
    numbers["horizon"] = N
    ok = needed < N or needed == 1
    return Finding("horizon", ok, numbers, f"Take a horizon of {2 * needed} or more." * (not ok))


def _disturbances(design: Design) -> Finding:
    """The outputs tell the disturbances from the state."""
    plant, w = design.normal.plant, design.normal.disturbances
    matrix = np.block([[plant.A - np.eye(len(plant.A)), w.B], [plant.C, w.C]])
    matrix = matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    _, sizes, V = np.linalg.svd(matrix)
    ok = not w.names or bool(sizes[-1] > HIDDEN)
    numbers: dict[str, Any] = {"estimated": ", ".join(w.names) or "none"}
    numbers["smallest singular value"] = sizes[-1]
    hidden = w.names[int(np.abs(V[-1, len(plant.A) :]).argmax())] if w.names else ""
    remedy = f"Take disturbances='auto': the {hidden} looks like a slow mode."
    return Finding("disturbances", ok, numbers, remedy * (not ok))


@torch.no_grad()
def _hard_rows(mpc: LinearMPC, r: Array, known: Array) -> Finding:
    """Outputs off the set-point, and last inputs at their bounds, leave a plan."""
    design, n_y = mpc.design, len(mpc.design.Q)
    half = np.diag(design.scaling.y)
    off = np.linspace(0.05, LARGEST, 40)[:, None, None] * np.vstack((half, -half))
    off = off.reshape(-1, n_y)
    rest = mpc.target(r[0] if len(r) else middle(design.y_bounds), known=known)
    of_y, _, of_x, _ = design.scaling
    x = (off / of_y) @ np.linalg.pinv(design.normal.plant.C).T * of_x
    x = rest.x.numpy() + np.vstack((x, np.zeros((2, len(of_x)))))
    ends = np.where(np.isfinite(design.u_bounds), design.u_bounds, rest.u.numpy())
    u_last = np.vstack((np.tile(rest.u, (len(off), 1)), ends))
    stages = (len(x), mpc.horizon + 1) if design.references == "preview" else (len(x),)
    target = Target(*(part.expand(*stages, -1) for part in rest))
    ahead = np.tile(known, (len(x), mpc.horizon + 1, 1))
    p = mpc.arrange(x, target, u_last=u_last, known=ahead, level=known)
    status = solve_qp(mpc.plan.quadratic_program(), p, solver="daqp", on_failure="mask").status
    hard = design.bounded[0] & np.isinf(design.y_slack)
    names = ", ".join(name for name, x in zip(design.plant.outputs, hard, strict=True) if x)
    numbers: dict[str, Any] = {"hard bounds of": names or "no output"}
    failed = (status == Status.INFEASIBLE).nonzero().flatten().tolist()
    if not failed:
        return Finding("hard bounds", True, numbers)
    if (i := failed[0]) < len(off):
        numbers |= {"outputs off the set-point that leave no plan": off[i], "at the state": x[i]}
    else:
        numbers |= {"last inputs that leave no plan": u_last[i]}
    return Finding("hard bounds", False, numbers, f"Give {names} a finite y_slack.")


class Setting(NamedTuple):
    """An MPC at an estimate of the disturbances and at known signals that are held."""

    mpc: LinearMPC
    w: Array
    known: Array

    def target(self, r: Array) -> Target:
        """Return the target of set-points ``(*batch, n_y)``."""
        return self.mpc.target(r, self.w, self.known)

    def off(self, y: Array, r: Array) -> Array:
        """Return the mask of outputs with a weight that are off their set-points."""
        design = self.mpc.design
        return (np.diag(design.Q) > 0) & (np.abs(y - r) > OFFSET * design.scaling.y)


def _set_points(setting: Setting, r_last: Array, assumed: bool) -> Finding:
    """Set-points and bands of outputs are within reach of the inputs' bounds."""
    design, known = setting.mpc.design, setting.known
    names, weighted = design.plant.outputs, np.diag(design.Q) > 0
    lower, upper = _reach(setting)
    how = " (not known, assumed)" * assumed
    acting = np.flatnonzero(design.plant.E.any(0))
    numbers: dict[str, Any] = {f"at {design.plant.known[i]}{how}": known[i] for i in acting}
    faults = []
    if np.isnan(lower).any():
        remedy = (
            "No input within its bounds holds the plant at these known signals: widen u_bounds."
        )
        return Finding("set-points", False, numbers | {"outputs in reach": "none"}, remedy)
    for i, name in enumerate(names):
        numbers[f"{name} reaches"] = np.array([lower[i], upper[i]])
        if lower[i] > design.y_bounds[1][i] or upper[i] < design.y_bounds[0][i]:
            faults.append(f"Let y_bounds of {name} overlap {lower[i]:.4g} .. {upper[i]:.4g}.")
    if len(r_last) and weighted.any():
        r, target = r_last[-1], setting.target(r_last[-1])
        y = target.y.numpy()
        off = setting.off(y, r)
        numbers |= {f"nearest {names[i]}": y[i] for i in np.flatnonzero(off)}
        for i, word in _settable(setting, r).items() if off.any() else ():
            limits = _limits(design, target)
            faults.append(f"Set {names[i]} to {word}, not {r[i]:.10g}, {limits}.")
    return Finding("set-points", not faults, numbers, " ".join(faults))


def _settable(setting: Setting, r: Array) -> dict[int, str]:
    """Return the entries of r that must change for it to be in reach, as they may be typed.

    They have four digits, or as many as it takes.
    """
    design, y = setting.mpc.design, setting.target(r).y.numpy()
    wanted = np.where(setting.off(y, r), np.clip(y, *design.y_bounds), r)
    for _ in range(SETTLES):
        y = setting.target(wanted).y.numpy()
        if not (off := setting.off(y, wanted)).any():
            break
        wanted = np.where(off, y, wanted)
    changed = np.flatnonzero(setting.off(wanted, r))
    words: dict[int, str] = {}
    for digits in range(4, 13):
        words = {int(i): f"{wanted[i]:.{digits}g}" for i in changed}
        typed = r.copy()
        typed[changed] = [*map(float, words.values())]
        if not setting.off(setting.target(typed).y.numpy(), typed).any():
            break
    return words


def _limits(design: Design, target: Target) -> str:
    """Return what a user can do about the bounds that a target is at."""
    named = []
    for kind, names, bounds, x, size in (
        ("y_bounds", design.plant.outputs, design.y_bounds, target.y.numpy(), design.scaling.y),
        ("u_bounds", design.plant.inputs, design.u_bounds, target.u.numpy(), design.scaling.u),
    ):
        near = OFFSET * size
        at = np.flatnonzero((x <= bounds[0] + near) | (x >= bounds[1] - near))
        if len(at):
            named.append(f"{kind} of {' and '.join(names[i] for i in at)}")
    if not named:
        return "as no inputs hold these set-points together"
    return f"or widen {' or '.join(named)}"


def _reach(setting: Setting) -> tuple[Array, Array]:
    """Return the least and the largest steady value of each output within the inputs' bounds.

    They are NaN if there is no steady state.
    """
    design = setting.mpc.design
    steady, loads = design.steady, np.concatenate((setting.w, setting.known, [1.0]))
    lower, upper = (side - steady.u @ loads for side in design.u_bounds)
    of_y, of_u, *_ = design.scaling
    rows = np.vstack((steady.U, -steady.U)) / np.tile(of_u, 2)[:, None]
    limits = np.concatenate((upper, -lower)) / np.tile(of_u, 2)
    kept = np.isfinite(limits)
    ends = []
    for y in steady.Y / of_y[:, None]:
        both = []
        for sign in (1, -1):
            least = scipy.optimize.linprog(
                sign * y, rows[kept], limits[kept], bounds=(None, None), method="highs"
            )
            otherwise = np.nan if least.status == 2 else -sign * np.inf  # infeasible, or unbounded
            both.append(sign * least.fun if least.status == 0 else otherwise)
        ends.append(both)
    ends = np.array(ends).T * of_y + steady.y @ loads
    return ends[0], ends[1]


def _condition(design: Design, smallest: float, largest: float) -> Finding:
    """The QP's numbers are exact enough."""
    ok, remedy = bool(largest < CONDITION * smallest), _weighted(design, largest)
    return Finding(
        "condition", ok, {"of the cost on the plan": largest / smallest}, remedy * (not ok)
    )


def _stability(loop: LinearLoop, gamma: float) -> Finding:
    """The loop without bounds is stable."""
    eigenvalues = np.abs(np.linalg.eigvals(loop.A))
    slow = np.sort(eigenvalues)[::-1][:3]
    ok = bool(loop.radius < 1 - 1e-9)
    remedy = "Take gamma=1." if gamma < 1 else "Lengthen the horizon, or weight more outputs."
    return Finding("stability", ok, {"largest eigenvalues": slow}, remedy * (not ok))


def _margin(loop: LinearLoop, law: Law, plan: Tables, target: Tables) -> Finding:
    """The loop without bounds tolerates errors of the model."""
    margin = loop.modulus_margin()
    gains = np.array([1 / (1 + margin), 1 / max(1 - margin, 1e-9)])
    numbers = {
        "modulus margin": margin,
        "gains": gains,
        "phase in degrees": np.degrees(2 * np.arcsin(min(margin / 2, 1.0))),
    }
    if margin >= MARGIN:
        return Finding("margin", True, numbers)
    longest = PATIENCE * max(_settling(loop), law.design.horizon)
    for remedy, slower in _slower(law, plan, target, "noise", 10.0):
        if not _settling(slower) <= longest:
            break
        if slower.modulus_margin() >= MARGIN:
            return Finding("margin", False, numbers, remedy)
    return Finding("margin", False, numbers, DAMP)


def _noise(
    loop: LinearLoop, law: Law, plan: Tables, target: Tables, noise: tuple[Array, Array]
) -> Finding:
    """Under the identified noise the loop costs hardly more than a constant input does."""
    design, cost = law.design, loop.cost_of_noise(law.design, noise)
    nothing = loop.cost_of_noise(design, noise, active=False)
    numbers = {"cost of a step": cost, "of a constant input": nothing}
    if cost <= NOISY * nothing:
        return Finding("noise", True, numbers)
    for remedy, slower in _slower(law, plan, target, "drift", 0.1):
        if slower.cost_of_noise(design, noise) <= NOISY * nothing:
            return Finding("noise", False, numbers, remedy)
    return Finding("noise", False, numbers, DAMP)


def _slower(
    law: Law, plan: Tables, target: Tables, option: str, factor: float
) -> Iterator[tuple[str, LinearLoop]]:
    """Yield remedies that multiply a filter's deviations by powers of a factor, and their loops."""
    design, own = law.design, {"noise": law.noise, "drift": law.drift}
    names = {"noise": design.plant.outputs, "drift": design.disturbances.names}[option]
    for power in range(1, SLOWEST + 1):
        slow = own | {option: own[option] * factor**power}
        pairs = zip(names, slow[option].tolist(), strict=True)
        text = ", ".join(f"{name!r}: {x:.3g}" for name, x in pairs)
        remedy = f"Slow the filter down, by qm.Controller(.., {option}={{{text}}})."
        yield remedy, LinearLoop.of(law.mpc, kalman(design, **slow), plan, target)


def _settling(loop: LinearLoop) -> float:
    """Return the loop's dominant time constant in steps; inf if it is unstable."""
    return -1 / np.log(max(loop.radius, 1e-9)) if loop.radius < 1 else np.inf


def _offset(loop: LinearLoop, design: Design) -> Finding:
    """Constant loads, biases and set-points leave no offset that steady inputs could remove."""
    Y = design.steady.Y
    removable = Y @ np.linalg.pinv(Y.T @ design.Q @ Y, rcond=1e-10) @ Y.T @ design.Q
    m = len(design.plant.inputs)
    n_y = len(Y)
    units = np.concatenate((design.scaling.u, *[design.scaling.y] * 2))
    off = np.abs(removable @ loop.offsets() * units) / design.scaling.y[:, None]
    parts = {"load": off[:, :m], "bias": off[:, m : m + n_y], "set-point": off[:, m + n_y :]}
    numbers = {f"offset of a full {key}": x.max(initial=0.0) for key, x in parts.items()}
    ok = bool(off.max(initial=0.0) < OFFSET)
    remedy = "Take disturbances='auto': one for each output."
    return Finding("offset", ok, numbers, remedy * (not ok))


def _weights(law: Law, known: Array) -> Finding:
    """Each output's weight matters for the cost of a closed loop with moving set-points and a load.

    By the envelope theorem a weight's share of the cost J is d log J / d log weight, as the inputs
    are nearly optimal for the weights. With entries off the diagonal it is a row's, which may be
    negative.
    """
    design, rng = law.design, np.random.default_rng(0)
    names, Q = design.plant.outputs, design.Q
    moves = rng.uniform(-1, 1, (-(-PROBED // HELD), len(Q))).repeat(HELD, 0)
    options: dict[str, Any] = dict(zip("xu", at_rest(law.mpc, known), strict=True))
    options |= {"known": known, "load": LOAD * design.scaling.u}
    r, costs = centre(design, known) + MOVE * design.scaling.y * moves, {}
    with suppress(QPError, SolverError):  # no plan, or outputs that overflow
        run = simulate(law, Memory(options["u"]), None, PROBED, r, **options)
        du = np.diff(run.u, axis=0, prepend=run.u_last[None])
        for name, W, x, of in (
            ("Q", Q, run.y[:-1] - run.r[:-1], names),
            ("R", design.R, run.u - run.u_s, design.plant.inputs),
            ("dR", design.dR, du, design.plant.inputs),
        ):
            parts = (x * (x @ W)).sum(0)
            costs |= {f"{name} of {of[i]}": float(parts[i]) for i in np.flatnonzero(W.any(0))}
    whole = sum(costs.values()) or 1.0
    shares = {name: cost / whole for name, cost in sorted(costs.items(), key=lambda x: -x[1])}
    numbers = {f"share of {name} in the cost": share for name, share in shares.items()}
    remedies = []
    for i in np.flatnonzero(Q.any(0)):
        share = abs(shares.get(f"Q of {names[i]}", 1))
        if share < IDLE:
            to = f"Raise Q of {names[i]} to {NOTED / share * Q[i, i]:.1g}, or leave" * (share > 0)
            remedies.append(f"{to or 'Leave'} it out: {names[i]} does not matter.")
    return Finding("weights", not remedies, numbers, " ".join(remedies))


def _number(x: Any) -> str:
    if isinstance(x, np.ndarray):
        return "[" + ", ".join(f"{y:.4g}" for y in x.ravel()) + "]"
    return x if isinstance(x, str) else f"{x:.4g}"
