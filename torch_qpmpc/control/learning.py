"""`Controller.learn`: a model from closed loops or a log; and `improve`: theta by gradients.

The candidate of `learn` has the new model in its observer, its target and its plan. Paired loops,
with the same set-points and noise for both, decide (`torch_qpmpc.learning.gate.PairedTest`).
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torch_qpmpc.checks import check_seed, check_whole
from torch_qpmpc.control.design import Design
from torch_qpmpc.control.disturbance import choose
from torch_qpmpc.control.law import Law, Memory
from torch_qpmpc.control.linear_mpc import LinearMPC
from torch_qpmpc.control.observer import SMALL
from torch_qpmpc.control.simulation import Run, simulate
from torch_qpmpc.control.state_space import Array, StateSpace, read_model, read_vector
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.identification.identification import Identified, identify
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.log import STILL, Log, Trajectory, folds
from torch_qpmpc.identification.reading import as_log
from torch_qpmpc.identification.subspace import explained_by_inputs
from torch_qpmpc.learning.closed_loop import MEMBERS, Improvement, SimulatedPlant, crossed, ensemble
from torch_qpmpc.learning.closed_loop import improve as descend
from torch_qpmpc.learning.gate import FEWEST, PairedTest
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import check_no_levels

#: Number of parts that a log is cut into; the last one is held out.
PARTS = 3
#: The plant of the loops with a log.
LAST = "a model of the log's last third"
#: The least gain, as a share of the old cost, that pairs must show, and the most that inputs may
#: explain of the residuals of their rows, in feedback, where a model decides.
GAIN, FED_BACK = 0.01, 0.5
#: Maps a law and the entropy of set-points and noise to a closed loop.
Loop = Callable[[Law, tuple[int, ...]], Run]


@dataclass(frozen=True)
class LearningReport:
    """The outcome of `Controller.learn`; ``print`` shows it.

    The controller has changed if it is ``accepted``. ``before`` and ``after`` are the mean costs of
    ``pairs`` of closed loops of ``steps`` with the ``plant``, with the old and the new ``model`` of
    so many ``transitions``; the 95 % ``interval`` is that of the mean difference of their costs,
    plus the hundredth of the old one that is the least gain.
    """

    accepted: bool
    before: float
    after: float
    pairs: int
    interval: tuple[float, float]
    steps: int
    transitions: int
    plant: str
    model: Identified

    def __str__(self) -> str:
        low, high = self.interval
        proof = f"mean difference and 1 % of J in [{low:.3g}, {high:.3g}] with 95 %"
        gain = self.before - self.after - GAIN * abs(self.before)
        if not self.accepted and low < 0 < gain:  # without a gain it stops before its last pair
            proof += ", so that more pairs could decide"
        if self.pairs < FEWEST or math.isinf(self.after):
            proof = "a loop with the new model failed, or cost far more than its pair: a veto"
        verdict = "accepted" if self.accepted else "not accepted, the controller is as before"
        return (
            f"{verdict}: J {self.before:.4g} -> {self.after:.4g} in {self.pairs} pairs of closed "
            f"loops of {self.steps} steps on {self.plant}\n"
            f"{proof}; the model is fitted to {self.transitions} transitions"
        )


def learn(
    law: Law,
    memory: Memory,
    source: Any,
    transitions: int,
    *,
    r: Any = None,
    known: Any = None,
    spread: Any = None,
    steps: int = 100,
    pairs: int = 64,
    seed: int = 0,
) -> tuple[LearningReport, Law]:
    """Return the report and the law with the new model; see `Controller.learn`."""
    law.design.plant.check_linear("learn")
    check_whole("transitions", transitions, 1)
    check_whole("steps", steps, 1)
    check_whole("pairs", pairs, FEWEST)
    check_seed(seed)
    if hasattr(source, "reset"):
        middle, name = law.read_set_points(r, 1, memory.r)[0], "the environment"
        around = middle, _sizes(law.design, spread, SMALL * law.design.usual)
        loop = _loops(law.design, memory, source, around, steps, known=known)
        log = _gathered(loop, law, -(-transitions // steps), seed)
    elif known is not None:
        raise QPError.expected("known", "signals beside a log", "None: the log has its own")
    else:
        log, held_out = _parts(_checked(as_log(source), law.design.plant))
        loop, name = _with_log(law, memory, held_out, r, spread, steps), LAST
    model = _identified(log, law.design.plant)
    candidate = _with_model(law, model)
    test, costs = _compare(loop, law, candidate, pairs, seed)
    before, after = np.mean(costs, axis=0).tolist()
    shown = test.decision == "better", before, after, test.pairs, test.interval
    return LearningReport(*shown, steps, log.steps, name, model), candidate


def _with_log(law: Law, memory: Memory, held_out: Log, r: Any, spread: Any, steps: int) -> Loop:
    """Return loops with a model of a part of a log, at its levels, with its known signals."""
    design, around = law.design, _set_points(law, memory, held_out, r, spread)
    identified = _identified(held_out, design.plant)
    if (share := explained_by_inputs(identified.model, held_out.trajectories).max()) > FED_BACK:
        got = f"inputs in the last third that follow the outputs alone by {share:.0%}"
        remedy = "Move the set-points, or add a random signal to the inputs."
        raise QPError.expected("log", got, "some that also move by themselves", remedy)
    d = torch.cat([one.d for one in held_out.trajectories]).numpy()
    model = read_model(identified, prices=design.linear.values())
    own = replace(design, plant=model, disturbances=choose(model, None))
    x, u, *_ = LinearMPC.of_design(own).target(around[0], known=d.mean(0))
    rest = {"x": x.numpy(), "u": u.numpy(), "noise": np.sqrt(np.diag(identified.fit.model.S))}
    return _loops(design, memory, model, around, steps, d, **rest)


def _loops(
    design: Design, memory: Memory, plant: Any, around: Any, steps: int, d: Any = None, **rest: Any
) -> Loop:
    """Return loops with set-points ``around`` a middle, each held for half a horizon."""
    (middle, size), hold = around, max(design.horizon // 2, 1)

    def loop(law: Law, entropy: tuple[int, ...]) -> Run:
        rng = np.random.default_rng(entropy)
        seed = int(rng.integers(2**31))
        levels = middle + size * rng.uniform(-1, 1, (-(-steps // hold), len(middle)))
        r = np.clip(levels, *design.y_bounds).repeat(hold, axis=0)
        if d is not None:
            start = int(rng.integers(max(len(d) - steps, 1)))
            rest["known"] = d[np.minimum(start + np.arange(steps), len(d) - 1)]
        return simulate(law, memory, plant, steps, r, seed=seed, **rest)

    return loop


def _set_points(law: Law, memory: Memory, log: Log, r: Any, spread: Any) -> tuple[Array, Array]:
    """Return the middle of the set-points and their distances from it, by default the log's."""
    y = torch.cat([one.y for one in log.trajectories]).numpy()
    middle = np.nanmean(y, 0) if r is None else law.read_set_points(r, 1, memory.r)[0]
    sizes = _sizes(law.design, spread, np.nanstd(y, 0))
    return np.clip(middle, *law.design.y_bounds), sizes


def _sizes(design: Design, spread: Any, default: Array) -> Array:
    if spread is None:
        return default
    size = read_vector("spread", spread, design.plant.outputs, 0.0)
    if not ((size > 0).any() and (size >= 0).all() and np.isfinite(size).all()):
        raise QPError.expected("spread", f"{size.tolist()}", "distances >= 0, not all of them 0")
    return size


def _gathered(loop: Loop, law: Law, loops: int, seed: int) -> Log:
    """Return closed loops with moving set-points as a log."""
    bar = tqdm(range(loops), "transitions", unit="loop", leave=False, disable=None)
    runs = [loop(law, (seed, 0, k)) for k in bar]
    parts = ([torch.from_numpy(x) for x in (run.y, run.u, run.known)] for run in runs)
    model = law.design.plant
    names = model.outputs, model.inputs, model.known
    return Log([Trajectory(*part) for part in parts], *names, model.units, model.dt)


def _checked(log: Log, plant: StateSpace) -> Log:
    """Return a log of a plant's signals at its sampling time."""
    for kind in ("outputs", "inputs", "known"):
        got, want = getattr(log, kind), getattr(plant, kind)
        if got != want:
            remedy = f"Pass qm.read_log(.., {kind}={list(want)})."
            raise QPError.expected("log", f"{kind} {got}", f"the controller's {want}", remedy)
    if log.dt and plant.dt and not np.isclose(log.dt, plant.dt):
        got, want = f"one step every {log.dt:g}", f"the controller's sampling time, {plant.dt:g}"
        raise QPError.expected("log", got, want, "Resample the log.")
    return log


def _parts(log: Log) -> tuple[Log, Log]:
    """Return the beginning of a log and the part that is held out."""
    *parts, held_out = folds(log.trajectories, PARTS)
    first = [trajectory for part in parts for trajectory in part]
    return replace(log, trajectories=first), replace(log, trajectories=held_out)


def _identified(log: Log, plant: StateSpace) -> Identified:
    """Fit a model of as many states as the controller's."""
    d = torch.cat([trajectory.d for trajectory in log.trajectories])
    for name, column, acts in zip(plant.known, d.mT, np.any(plant.E, axis=0), strict=True):
        if acts and column.std() <= STILL * column.abs().max():
            remedy = "Its effect cannot be learned: pass rows in which it varies."
            raise QPError.expected("known", f"a constant {name}", "one that varies", remedy)
    order = len(plant.A) + plant.drifts.shape[1]
    return identify(log, 1 if plant.errors is None else plant.errors.shape[1], order=order)


def _with_model(law: Law, model: Identified) -> Law:
    """Return the law with another model."""
    old = law.design
    plant = read_model(model, prices=old.linear.values())
    w = choose(plant, old.disturbances.wanted, replace(old, plant=plant).scaling)
    design = replace(old, plant=plant, disturbances=w)
    mpc = LinearMPC.of_design(design, **law.mpc.options)
    return Law.of(mpc, law.noise, law.drift if w.names == old.disturbances.names else None)


def _compare(
    loop: Loop, old: Law, new: Law, pairs: int, seed: int
) -> tuple[PairedTest, list[tuple[float, float]]]:
    """Return the test of pairs of closed loops, and the costs of each.

    Both pay weights of inputs about the old law's targets.
    """
    test, costs = PairedTest(), []
    for k in tqdm(range(pairs), "comparison", unit="pair", leave=False, disable=None):
        run = loop(old, (seed, 1, k))
        before = run.cost.sum()
        try:
            after = loop(new, (seed, 1, k)).costs(run.u_s).sum()
        except (QPError, SolverError):  # no plan, or outputs that overflow
            after = math.inf
        costs.append((before, after))
        finite = math.isfinite(before + after)
        difference = after - before + GAIN * abs(before) if finite else math.inf
        test.add(torch.tensor([difference], dtype=torch.float64))
        hopeless = test.pairs >= FEWEST and test.mean >= 0
        if test.decision != "open" or hopeless:
            break
    return test, costs


def improve(
    law: Law, memory: Memory, source: Any, r: Any, spread: Any, **options: Any
) -> tuple[Improvement, Law]:
    """Return the report and the law with the new theta; see `Controller.improve`."""
    law.design.plant.check_linear("improve")
    check_no_levels(law.mpc.plan, "gradients of closed loops")
    members, seed = options.pop("members", MEMBERS), options.get("seed", 0)
    check_whole("members", members, 1)
    check_seed(seed)
    log = _checked(as_log(source), law.design.plant)
    set_points = _set_points(law, memory, log, r, spread)
    models = ensemble(_identified(log, law.design.plant), members, seed)
    law = replace(law, mpc=copy.deepcopy(law.mpc))
    plan = law.mpc.plan
    masks = steady(law.design, plan)
    leaves = {k: x for k, x in plan.coordinates().items() if k in masks and x.requires_grad}
    hooks = [x.register_hook(masks[name].to(x).mul) for name, x in leaves.items()]
    plant = crossed(models, lambda part: ControlledPlant(law, part, log, *set_points))
    report = descend(plan, plant, **options)
    for hook in hooks:
        hook.remove()
    held = ", ".join(name for name in leaves if not masks[name].any())
    notes = (f"Held, as outputs would settle beside r: {held}.",) if held else ()
    return replace(report, notes=(*report.notes, *notes)), law


def steady(design: Design, plan: QPMPC) -> dict[str, Tensor]:
    """Return the masks of the coordinates of theta that may move; others may as a whole.

    At rest all signals of a stage are zero but constants, which place the bounds, and known ones
    that do not act on the plant. The plan stays zero if no cost and no prediction depends on them.
    """
    s, layout, none = design.selectors(), plan.layout, torch.zeros(1, dtype=torch.bool)
    zero = np.vstack([s[name] for name in ("r", "u_r", "x", "u_last", "u")])
    fixed = torch.as_tensor(~np.vstack((zero, s["known"][design.acts])).any(0))
    of_d, of_x, of_u = fixed.split([plan.n_d, plan.n_x, plan.n_u])
    of_z = torch.cat((of_d.repeat(plan.horizon + 1), layout.stages(of_x, of_u)))
    moves = ~of_x[:, None]
    masks = {"H": fixed[:, None] == fixed, "A": moves & ~of_x, "B": moves, "E": moves & ~of_d}
    masks["H_f"] = masks["H"][: -plan.n_u, : -plan.n_u]
    return masks | {"C": moves.repeat(plan.horizon, 1) & ~of_z, "q": none, "b": none}


class ControlledPlant(SimulatedPlant):
    """Models under a law's observer and target, whose policy sees the p of its plan.

    The state goes on with [u_last, r, u_s, p], and actions are relative to u_s. Loops start at the
    log's steps within the outputs' bounds, if there are any. Set-points are within ``size`` of
    ``middle``, each held for half a horizon or, in half of the loops, to their end.
    """

    def __init__(
        self, law: Law, models: list[Innovations], log: Log, middle: Array, size: Array
    ) -> None:
        y, u, d = (x[0].nan_to_num().numpy() for x in log.trajectories[0])
        own = law.observer  # whose gain is the steady one, as its estimates in the log are
        ends = own.L, own.S, own.at_rest(u, d, y), np.zeros_like(own.F)
        observer = Innovations(own.F, own.G, own.E, own.offset, own.H, *ends)
        super().__init__(models, observer, log.trajectories, self.cost, law.design.horizon)
        self._mpc, self._design, self._from_log = copy.deepcopy(law.mpc), law.design, True
        self._mpc.targets.on_failure = "mask"
        self._levels = [*map(torch.as_tensor, (middle, size, *law.design.y_bounds))]
        inside = (self._y.clamp(*self._levels[2:]) == self._y).all(-1)
        self._rows = self._rows[inside | ~inside.any()]
        m, n_y = len(law.design.R), len(middle)
        self._ends = [sum(self._sizes), m, n_y, m, law.mpc.plan.n_p]

    def starts(self, rng: torch.Generator, count: int) -> Tensor:
        s = super().starts(rng, count)
        row = self._row(s)[:, 0]
        u_last = self._u[(row - 1).maximum(self._first[row])]
        return self._planned(s, u_last, self._aims(rng, count))

    def draw(self, rng: torch.Generator, count: int) -> Tensor:
        return torch.cat((super().draw(rng, count), self._aims(rng, count)), -1)

    def known(self, s: Tensor) -> Tensor:
        return s.split(self._ends, -1)[-1]

    def step(self, s: Tensor, a: Tensor, nu: Tensor) -> Tensor:
        (base, _, r, *_), (*e, aims) = s.split(self._ends, -1), nu.split(self._sizes[2], -1)
        u = self._input(s, a)
        base = super().step(base, u, torch.cat(e, -1))
        moves = base[:, -2].detach() % max(self._horizon // 2, 1) == 0
        moves &= torch.arange(len(s)) // self.members % 2 == 0
        return self._planned(base, u, torch.where(moves[:, None], aims, r))

    def cost(self, s: Tensor, a: Tensor) -> Tensor:
        """Return `Run.costs` of a step, ``(count,)``."""
        base, u_last, r, u_s, p = s.split(self._ends, -1)
        y, u, d = self._parts(base)[2], self._input(s, a), self._ahead(base)[:, 0]
        if (place := self._design.places["u_r"]).stop > place.start:  # p begins with a stage
            u_s = u_s + p[:, place]
        return self._design.costs(y, r, u, u_s, u - u_last, d)

    def _aims(self, rng: torch.Generator, count: int) -> Tensor:
        """Draw set-points ``(count, n_y)``."""
        middle, size, lower, upper = self._levels
        share = torch.rand(count, len(middle), generator=rng, dtype=middle.dtype)
        return (middle + size * (2 * share - 1)).clamp(lower, upper)

    def _input(self, s: Tensor, a: Tensor) -> Tensor:
        """Return the input of an action, within its bounds."""
        base, _, _, u_s, _ = s.split(self._ends, -1)
        bounds = self._design.bounds_at(self._ahead(base)[:, 0].numpy())[1]
        return torch.clamp(u_s + a, *map(torch.as_tensor, bounds))

    def _planned(self, base: Tensor, u_last: Tensor, r: Tensor) -> Tensor:
        """Return the states with the target and p of the next plan."""
        x, w = self._parts(base)[1].tensor_split([len(self._design.plant.A)], -1)
        known, staged = self._ahead(base, self._horizon), self._design.staged
        aim, load = (v[:, None].expand(-1, known.shape[1], -1) for v in (r, w))
        loads = (aim, load, known) if staged else (r, w, known[:, -1])
        target = self._mpc.target(*loads)
        p = self._mpc.arrange(x, target, u_last=u_last, known=known)
        return torch.cat((base, u_last, r, target.u[:, -1] if staged else target.u, p), -1)
