"""`Controller.review`: what is wrong with a design, in sentences, with a remedy for each fault."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy  # imports scipy.optimize at its first use: a third of a second

from torch_qpmpc.control.design import DECIDES, Design, Target
from torch_qpmpc.control.disturbance import HIDDEN, choose, told_apart, unseen_modes
from torch_qpmpc.control.law import Law, Memory
from torch_qpmpc.control.linear_loop import LinearLoop
from torch_qpmpc.control.linear_mpc import LinearMPC
from torch_qpmpc.control.lowering import riccati
from torch_qpmpc.control.simulation import centre, last_known, simulate
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError, SolverError

#: A number beyond these is a fault. A modulus margin of 0.5 is the usual aim.
MARGIN = 0.3
#: The most that the log's noise moves outputs, relative to constant inputs, and inputs in bounds.
NOISY, BUSY = 1.25, 1 / 6  # of their distance: three deviations reach from the middle to an end
#: Offsets of the loop and ends of the reach, of set-points, and of outputs from their bounds while
#: inputs are on levels, relative to half the distance of an output's bounds.
OFFSET, SEEN, OUTSIDE = 1e-6, 1e-3, 0.05
#: A response below this share of those soon after, with inputs of half their range, is noise.
SHOWS = 0.03
#: The length of the loop on levels, in horizons, of which the second half counts.
PERIODS = 6


@dataclass(frozen=True)
class Finding:
    """One question to a design.

    It has a ``name``, whether it is ``ok``, the answer ``text``, the ``remedy`` of a fault, and
    ``numbers`` for programs: what the outputs reach, and when they respond.
    """

    name: str
    ok: bool
    text: str
    remedy: str = ""
    numbers: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Review:
    """The ``findings`` about a controller; ``print`` shows them."""

    findings: list[Finding]

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
    mpc, design, r_last, errors = law.mpc, law.design, memory.r, law.design.plant.errors
    if r is not None:
        rows = 1 if design.references == "held" else design.horizon + 1
        r_last = law.read_set_points(r, rows, memory.r)
    assumed = known is None and memory.known is None
    known = last_known(design, memory) if known is None else law.read_known(known, 1)[0]
    if design.plant.dynamics is not None and len(r_last):
        rows = design.horizon + 1, 1
        held = np.tile(r_last[-1], rows), np.tile(known, rows), law.estimates(memory)[1]
        law, _ = law.aimed(*held)
        mpc, design = law.mpc, law.design
    loop, wrong, terminal = None, "", _terminal(design)
    try:
        loop = LinearLoop.of(mpc, law.observer)
    except QPError as error:
        wrong = str(error)
        if not wrong.startswith("H: "):
            raise
    findings = [
        _cost(mpc, wrong),
        terminal,
        *([_model(design, errors)] if errors is not None and np.isfinite(errors).any() else []),
        *([_free_inputs(design)] if design.free.any() else []),
        *([_known(design)] if design.plant.known else []),
        *([_violation(design)] if design.violation else []),
        _horizon(design),
        _disturbances(design),
        hard_rows(design),
        set_points(mpc, law.estimates(memory)[1], known, r_last, assumed),
    ]
    findings += [_levels(law, r_last, known)] if design.levels else []
    if loop is None:
        return Review(findings)
    findings.append(_stability(loop, design.gamma, terminal.remedy))
    if findings[-1].ok:
        findings += [_margin(loop, law), _offset(loop, design)]
        if design.plant.noise is not None:
            findings.append(_noise(loop, law, design.plant.noise))
    return Review(findings)


def _cost(mpc: LinearMPC, wrong: str) -> Finding:
    """H is positive definite on the plans that satisfy C z = b: nothing is ``wrong`` with it."""
    design = mpc.design
    sizes = zip(design.plant.inputs, design.scaling.u, strict=True)
    least = {x: float(f"{1e-3 * (design.typical or 1.0) / size**2:.1g}") for x, size in sizes}
    remedy = f"Raise the weights of the inputs to R={least}."
    if mpc.plan.learned:
        remedy += " If learning has made it indefinite, mpc.plan.reset_parameters()."
    text = f"{wrong.partition('. ')[0]}." if wrong else "Each plan has a cost with one minimum."
    return Finding("cost", not wrong, text, remedy * bool(wrong))


def _terminal(design: Design) -> Finding:
    """The terminal weight is the cost to go of the loop without bounds."""
    plant, exists = design.normal.plant, riccati(design) is not None
    unseen = unseen_modes(plant.A, design.normal.Q @ plant.C)
    unmoved = unseen_modes(plant.A.T, plant.B.T)
    text = "The cost after the horizon is exact while no bound is active."
    why, remedy = "an input is free", "Weight all inputs, by R or dR."
    if len(unseen):
        why = f"a mode of size {abs(unseen[0][0]):.4g} has no weight"
        remedy = "Weight an output that shows this mode, by Q."
    elif len(design.steady.W) and not design.R.any():
        remedy = "Weight all inputs by R: several of them hold the same outputs."
    elif len(unmoved):
        why = f"no input moves a mode of size {abs(unmoved[0][0]):.4g}"
        remedy = "Remove the mode from the model, or pass it as a known signal."
    text = text if exists else f"The cost after the horizon is that of its end alone, as {why}."
    return Finding("terminal weight", exists, text, remedy * (not exists))


def _model(design: Design, errors: Array) -> Finding:
    """Predictions of rows that their fit has not seen err by less than the outputs vary."""
    plant, errors = design.plant, errors[:, np.isfinite(errors).any((0, 2))]
    moved = plant.C @ plant.visited[1] @ plant.C.T  # pyright: ignore[reportOptionalSubscript]
    varies = np.sqrt(np.diag(moved + plant.noise[1]))  # pyright: ignore[reportOptionalSubscript]
    off = np.sqrt(np.nanmean(errors[:, -1] ** 2, 0))
    pairs = zip(plant.outputs, off, varies, strict=True)
    each = (f"{plant.quantity(name, x)} of {y:.4g}" for name, x, y in pairs)
    text = f"Errors {errors.shape[1]} steps ahead, of the log's deviations: {', '.join(each)}."
    poor = " and ".join(plant.outputs[i] for i in design.weighted if off[i] > varies[i])
    remedy = f"The log does not show how to move {poor}: log more rows and larger moves."
    return Finding("model", not poor, text, remedy * bool(poor))


def _free_inputs(design: Design) -> Finding:
    """What inputs rest near that the set-points leave free."""
    pairs = zip(design.plant.inputs, design.resting, design.free, strict=True)
    rests = " and ".join(design.plant.quantity(name, x) for name, x, free in pairs if free)
    return Finding("free inputs", True, f"Set-points leave inputs free, which rest near {rests}.")


def _known(design: Design) -> Finding:
    """Each known signal moves a state, bounds a signal or is a price."""
    used = {*design.linear.values(), *sum(design.limits.values(), ())}
    acts = zip(design.plant.known, design.acts, strict=True)
    names = " and ".join(name for name, own in acts if not (own or name in used))
    text = f"{names} moves no state, bounds nothing and is no price." if names else "All act."
    return Finding("known signals", not names, text, "Pass its effect by E." * bool(names))


def _violation(design: Design) -> Finding:
    """What the log promises of the outputs' bounds."""
    parts = []
    for name, share in design.violation.items():
        i = design.plant.outputs.index(name)
        low, high = (design.plant.quantity("", x).strip() for x in design.margins[:, i])
        parts.append(
            f"{name} leaves each bound in at most {share:.3g} of the steps if errors are like the "
            f"log's and inputs suffice: plans stay {low} and {high} away, as predictions of step "
            f"{design.answers(DECIDES)[i]}, the first that an input decides, err by no more."
        )
    return Finding("violation", True, " ".join(parts))


def _horizon(design: Design) -> Finding:
    """The plan is longer than dead times and inverse responses."""
    N, first = design.horizon, design.answers(SHOWS)
    numbers = {design.plant.outputs[i]: int(first[i]) for i in design.weighted if first[i]}
    needed = max(numbers.values(), default=1)
    ok = needed < N or needed == 1
    after = "".join(f", until an input moves {name} {x}" for name, x in numbers.items())
    remedy = f"Take a horizon of {2 * needed} or more." * (not ok)
    return Finding("horizon", ok, f"Steps of the horizon {N}{after}.", remedy, numbers)


def _disturbances(design: Design) -> Finding:
    """The outputs tell the disturbances from the state."""
    plant, w = design.normal.plant, design.normal.disturbances
    if not w.names:
        return Finding("disturbances", True, "None is estimated.")
    size, direction = told_apart(plant, w)
    ok, hidden = size > HIDDEN, np.abs(direction[len(plant.A) :]).argmax()
    text = f"The outputs {'' if ok else 'hardly '}tell the {', '.join(w.names)} from the state "
    text += f"(singular value {size:.2g})."
    remedy = f"Take disturbances='auto': the {w.names[hidden]} looks like a slow mode."
    if not ok and choose(design.plant, "auto", design.scaling).names == w.names:
        remedy = "Take a model of smaller order: this one has a slow mode that inputs hardly move."
    return Finding("disturbances", ok, text, remedy * (not ok))


def hard_rows(design: Design) -> Finding:
    """Rows with outputs, which noise and loads may put out of reach, have finite prices."""
    rows = design.ends.beside(design.bands)
    hard = np.isinf(rows.price) & rows.W[:, : len(design.Q)].any(1)
    names = ", ".join(dict.fromkeys(rows.names[hard]))
    text = f"There is no plan while noise or a load holds {names} outside the hard bounds."
    price = "y_slack" if (rows.arguments[hard] == "y_bounds").all() else "price"
    remedy = f"Give {names} a finite {price}." * bool(names)
    return Finding("hard bounds", not names, text if names else "No output has one.", remedy)


def _levels(law: Law, r: Array, known: Array) -> Finding:
    """In a loop of the model, inputs on levels hold outputs within their bounds; and its price."""
    design, costs, steps = law.design, [], PERIODS * law.design.horizon
    plant, r = design.plant, r[-1] if len(r) else centre(design, known)
    x, u_s = (part.numpy() for part in law.mpc.target(r, known=known)[:2])
    relaxed = LinearMPC.of_design(replace(design, levels={}, switching={}), **law.mpc.options)
    try:
        for own in (replace(law, mpc=relaxed), law):
            run = simulate(own, law.begun(), None, steps, r, u=u_s, x=x, known=known)
            y, u, cost = (part[steps // 2 :] for part in (run.y, run.u, run.cost))
            costs.append(cost.mean() * bool(cost.mean() > OFFSET * design.typical))
    except SolverError as error:
        return Finding("levels", False, str(error), "Shorten min_on or min_off.")
    starts = np.diff((u > law.switches).astype(int), axis=0) > 0
    costs[1] += (starts @ np.array(design.switching["start_cost"])).mean()
    held = *zip(plant.outputs, y.T, strict=True), *zip(plant.inputs, u.T, strict=True)
    spans = (f"{plant.quantity(x, a.min())} to {a.max():.4g}, mean {a.mean():.4g}" for x, a in held)
    text = f"In a loop of the model: {'; '.join(spans)}. A step costs {costs[1]:.4g}, "
    text += f"without levels {costs[0]:.4g}."
    lower, upper = design.bounds_at(known)[0]
    off = np.maximum(lower - y, y - upper).max(0) / design.scaling.y
    names = " and ".join(np.array(plant.outputs)[off > OUTSIDE])
    remedy = f"Shorten min_on or min_off, add a level, or widen y_bounds of {names}."
    return Finding("levels", not names, text, remedy * bool(names))


def set_points(mpc: LinearMPC, w: Array, known: Array, r_last: Array, assumed: bool) -> Finding:
    """Return whether set-points and bands of outputs are within reach of the inputs' bounds.

    The estimate w of the disturbances and the known signals are held.
    """
    design, faults = mpc.design, []
    plant, (low, high) = design.plant, design.bounds_at(known, True)[0]
    lower, upper = (reach := _reach(design, w, known)).T
    held = [plant.quantity(plant.known[i], known[i]) for i in np.flatnonzero(plant.E.any(0))]
    at = f"At {' and '.join(held)}{' (assumed)' * assumed} the" if held else "The"
    if np.isnan(lower).any():
        text = f"{at} plant rests with no input within its bounds."
        return Finding("set-points", False, text, "Widen u_bounds.")
    numbers = {f"{name} reaches": ends for name, ends in zip(plant.outputs, reach, strict=True)}
    ends = zip(plant.outputs, *reach.T, strict=True)
    spans = (f"{plant.quantity(name, a)} to {b:.4g}" for name, a, b in ends)
    local = ", as far as the linearisation holds" * (plant.dynamics is not None)
    text = f"{at} outputs reach {', '.join(spans)}{local}."
    for i, name in enumerate(plant.outputs):
        if lower[i] > high[i] or upper[i] < low[i]:
            faults.append(f"Let y_bounds of {name} overlap {lower[i]:.4g} .. {upper[i]:.4g}.")
    if len(r_last) and design.Q.any():
        r, target = r_last[-1], mpc.target(r_last[-1], w, known)
        y, size = target.y.numpy(), design.scaling.y
        near = np.where(np.diag(design.Q) > 0, SEEN * size, np.inf)
        if plant.noise is not None:  # no one can see less than the outputs' own noise
            near = np.maximum(near, np.sqrt(np.diag(plant.noise[1])))
        if (off := np.abs(y - r) > near).any():  # soft bounds that the nearest one violates move it
            y = mpc.target(np.where(off, np.clip(y, low, high), r), w, known).y.numpy()
        for i in np.flatnonzero(np.abs(y - r) > near):
            word = f"{round(y[i], 4 - int(np.floor(np.log10(size[i])))):.10g}"
            limits = _limits(design, target, known)
            faults.append(f"Set {plant.outputs[i]} to {word}, not {r[i]:.10g}, {limits}.")
    return Finding("set-points", not faults, text, " ".join(faults), numbers)


def _limits(design: Design, target: Target, known: Array) -> str:
    """Return what a user can do about the bounds that a target is at."""
    bands, named = design.bands, []
    x = bands.W @ np.concatenate((target.y.numpy(), target.u.numpy()))
    near = OFFSET * bands.sizes(design.scaling.y, design.scaling.u)
    lower, upper = bands.at(known - design.nominal)
    at = ((x <= lower + near) | (x >= upper - near)) & bands.W.any(1)
    for argument in dict.fromkeys(bands.arguments[at]):
        names = dict.fromkeys(bands.names[at & (bands.arguments == argument)])
        named.append(f"{argument} of {' and '.join(names)}")
    impossible = "as no inputs hold these set-points together"
    return f"or widen {' or '.join(named)}" if named else impossible


def _reach(design: Design, w: Array, known: Array) -> Array:
    """Return the least and the largest steady value of each output, ``(n_y, 2)``, NaN without any.

    Inputs are within their bounds, and other outputs without a weight in their zones, if they can.
    """
    bands, n_y, steady = design.bands, len(design.Q), design.steady
    loads = np.concatenate((w, known, [1.0]))
    S = bands.W @ np.vstack((steady.Y, steady.U))
    rest = bands.W @ np.vstack((steady.y, steady.u)) @ loads
    lower, upper = bands.at(known - design.nominal)
    size = np.tile(bands.sizes(design.scaling.y, design.scaling.u), 2)
    rows = np.vstack((S, -S)) / size[:, None]
    limits = np.concatenate((upper - rest, rest - lower)) / size
    of_y = bands.arguments == "y_bounds"
    zones = of_y & ~(bands.W[:, :n_y] @ np.diag(design.Q)).astype(bool)
    hard, ends = ~of_y & np.isinf(bands.price), np.empty((n_y, 2))
    own = {"bounds": (None, None), "options": {"presolve": False}}  # presolve errs if unbounded
    for i, side in np.ndindex(n_y, 2):
        sign = 1 - 2 * side
        for kept in (hard | (zones & (bands.W[:, i] == 0)), hard):
            finite = np.isfinite(limits) & np.tile(kept, 2)
            c = sign * steady.Y[i] / design.scaling.y[i]
            least = scipy.optimize.linprog(c, rows[finite], limits[finite], **own)
            if least.status != 2:  # infeasible
                break
        ends[i, side] = sign * {0: least.fun, 2: np.nan}.get(least.status, -np.inf)
    ends = ends + (steady.y @ loads / design.scaling.y)[:, None]
    return np.where(np.abs(ends) < OFFSET, 0.0, ends) * design.scaling.y[:, None]


def _stability(loop: LinearLoop, gamma: float, of_terminal: str) -> Finding:
    """The loop without bounds is stable."""
    slow = np.sort(np.abs(np.linalg.eigvals(loop.A)))[::-1][:3]
    ok, listed = bool(loop.radius < 1 - 1e-9), ", ".join(f"{x:.4g}" for x in slow)
    text = f"Without active bounds, the loop's largest eigenvalues are {listed}."
    remedy = of_terminal or "Lengthen the horizon, or weight more outputs."
    remedy = "Take gamma=1." if gamma < 1 else remedy
    return Finding("stability", ok, text, remedy * (not ok))


def _margin(loop: LinearLoop, law: Law) -> Finding:
    """The loop without bounds tolerates errors of the model."""
    margin = loop.modulus_margin()
    least, most = 1 / (1 + margin), 1 / max(1 - margin, 1e-9)
    phase = np.degrees(2 * np.arcsin(min(margin / 2, 1.0)))
    text = f"An input's gain may be {least:.2f} to {most:.3g} times the model's, its phase "
    text += f"{phase:.0f} degrees off (modulus margin {margin:.2f})."
    remedy = _slower("noise", law.design.plant.outputs, 10 * law.noise)
    return Finding("margin", margin >= MARGIN, text, remedy * (margin < MARGIN))


def _noise(loop: LinearLoop, law: Law, noise: tuple[Array, Array]) -> Finding:
    """The log's noise moves outputs hardly more than if inputs rested, and no input to a bound."""
    design, span = law.design, np.diff(law.design.u_bounds, axis=0)[0]
    Q = design.Q if design.Q.any() else np.diag(design.typical / design.usual**2)
    (cost, u), inputs_rest = loop.under(noise, Q), LinearLoop.of(law.mpc, law.observer, held=True)
    more = np.sqrt(cost / (inputs_rest.under(noise, Q)[0] + OFFSET * design.typical))
    ok = bool(more <= NOISY and (u <= BUSY * np.where(span > 0, span, np.inf)).all())
    moved = ", ".join(map(design.plant.quantity, design.plant.inputs, u))
    text = f"The log's noise moves {moved}, and outputs {more:.3g} times as far as without control."
    remedy = _slower("drift", design.disturbances.names, law.drift / 10)
    return Finding("noise", ok, text, remedy * (not ok))


def _slower(option: str, names: tuple[str, ...], sizes: Array) -> str:
    own = ", ".join(f"{x!r}: {size:.3g}" for x, size in zip(names, sizes, strict=True))
    own = f"qm.Controller(.., {option}={{{own}}})"
    return f"Slow the filter down, as by {own}, or raise R and dR tenfold."


def _offset(loop: LinearLoop, design: Design) -> Finding:
    """Constant loads, biases and set-points leave no offset that steady inputs could remove."""
    Y = design.steady.Y
    removable = Y @ np.linalg.pinv(Y.T @ design.Q @ Y, rcond=1e-10) @ Y.T @ design.Q
    m, n_y = len(design.plant.inputs), len(Y)
    units = np.concatenate((design.scaling.u, *[design.scaling.y] * 2))
    off = np.abs(removable @ loop.offsets() * units) / design.scaling.y[:, None]
    parts = {"load": off[:, :m], "bias": off[:, m : m + n_y], "set-point": off[:, m + n_y :]}
    ok = bool(off.max(initial=0.0) < OFFSET)
    left = ", ".join(f"{x.max(initial=0.0).round(9):.2g} of a {key}" for key, x in parts.items())
    text = f"Offsets that inputs could remove, in half ranges of the outputs: {left}."
    remedy = "Take disturbances='auto': one for each output."
    return Finding("offset", ok, text, remedy * (not ok))
