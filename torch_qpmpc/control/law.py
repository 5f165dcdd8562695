"""The control law of a linear MPC: its observer, target and plan, as functions of a memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.control.design import Design, Target, largest, read_said
from torch_qpmpc.control.disturbance import PREFIX
from torch_qpmpc.control.linear_mpc import LinearMPC
from torch_qpmpc.control.lowering import aimed
from torch_qpmpc.control.observer import (
    ABSURD,
    SMALL,
    Observer,
    floored,
    kalman,
    max_plausible,
    moving,
)
from torch_qpmpc.control.state_space import Array, by_name, read_table
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.identification.learned import LearnedModel
from torch_qpmpc.mpc.nonlinear import SequentialQP
from torch_qpmpc.qp.pipeline.arrays import BatchSolution
from torch_qpmpc.qp.pipeline.solve import AtRest
from torch_qpmpc.qp.program import Status

#: A number of steps that exceeds each minimum time.
LONG = 2**30
#: Of a nonlinear plant, the most QPs of the first plan and of others, the most linearisations for a
#: point at rest, and the distance from it, relative to the signals' sizes, at which one is exact.
COLD, WARM, NEWTON, NEAR = 30, 2, 5, 1e-3


class Memory(NamedTuple):
    """What a controller keeps between two steps.

    Attributes:
        u, e: the last input ``(m,)``, and the next step's prediction of x and w, None at first.
        steps: the place of the next gain among `Observer.gains`, the last one from rest.
        r: the last valid set-points, ``(rows, n_y)``, without rows before the first.
        known: the known signals of the last step or reset, ``(n_d,)``, None before.
        runs: for how many steps each input was on (above its lowest level), or with a minus off;
            None without levels.
        ahead: the levels that the last plan has from the next step on, None without any.
        rest: the outputs and the input at rest that the last reset was passed, or None for each.
        P: the observer's P for the next step after a missing output, None while it is steady.
    """

    u: Array
    e: Array | None = None
    r: Array = np.zeros(0)
    known: Array | None = None
    rest: tuple[Array | None, Array | None] = (None, None)
    steps: int = 0
    P: Array | None = None
    runs: Array | None = None
    ahead: Array | None = None


class Signals(NamedTuple):
    """The signals of a step: outputs ``(n_y,)``, set-points and known signals of the stages.

    An output that is NaN or above `Law.max_plausible` is missing.
    """

    y: Array
    r: Array
    known: Array


class Outcome(IntEnum):
    """What a step has come to; functions in C return the same numbers.

    No valid signal is above `Law.max_plausible`. An input that stays is clipped into its bounds.
    """

    SOLVED = 0
    LIMIT = 1
    INFEASIBLE = 2
    INVALID = 3
    MISSING = 4
    NODE_LIMIT = 5

    def __str__(self) -> str:
        return self.name

    @property
    def explanation(self) -> str:
        """The outcome in words."""
        return (
            "All outputs are measured, and the input is optimal.",
            "The solver certified no plan: the last input stays.",
            "No plan keeps the hard bounds: the last input stays.",
            "A set-point, known signal or first output is invalid: the last input stays.",
            "Predictions stand for missing outputs, and the input is optimal for them.",
            "The best plan on levels that the search found; a better one may exist.",
        )[self]


#: Those with a plan.
PLANNED = (Outcome.SOLVED, Outcome.MISSING, Outcome.NODE_LIMIT)


class Move(NamedTuple):
    """The result of a step: input, memory and law after it, and target, p and plan, if any."""

    u: Array
    memory: Memory
    status: Outcome
    law: Law
    target: Target | None = None
    p: Array | None = None
    plan: BatchSolution | None = None


@dataclass(frozen=True, eq=False)
class Law:
    """A linear MPC with an observer, see `Controller`, and ``noise``, ``drift`` as its arrays.

    ``max_plausible`` are the largest sizes of outputs and set-points, and of known signals.
    """

    mpc: LinearMPC
    noise: Array
    drift: Array
    observer: Observer
    max_plausible: tuple[Array, Array]
    gain: Array | None = None

    @classmethod
    def of(cls, mpc: LinearMPC, noise: Any = None, drift: Any = None, gain: Any = None) -> Law:
        """Return the law of an MPC with today's theta.

        Raises:
            QPError: a deviation is invalid, or the model has no filter.
        """
        design, w = mpc.design, mpc.design.disturbances
        sizes, drifts = SMALL * design.usual, SMALL * design.of_w(design.usual)
        if design.plant.noise is not None:
            sizes = np.sqrt(np.diag(floored(design.plant.noise[1], design.usual)))
            drifts = np.where(np.greater(w.changes, 0), w.changes, moving(design, sizes))
        noise = _deviations("noise", noise, sizes, design.plant.outputs)
        drift = _deviations("drift", drift, drifts, w.names)
        observer = kalman(design, noise, drift)
        observer = observer if gain is None else observer.with_gain(gain)
        own = None if gain is None else observer.L
        return cls(mpc, noise, drift, observer, max_plausible(design, noise), own)

    @property
    def design(self) -> Design:
        """The design of the MPC."""
        return self.mpc.design

    @cached_property
    def plans(self) -> AtRest:
        """The solver of the plan's QP, with the theta of its first use."""
        return self.mpc.plan.at_rest()

    @cached_property
    def aims(self) -> AtRest:
        """The solver of the target's QP."""
        return self.mpc.targets.at_rest()

    def redesigned(self, **changes: Any) -> Law:
        """Return the law with other settings; see `Controller.redesign`."""
        names = {"noise": self.design.plant.outputs, "drift": self.design.disturbances.names}
        mpc = self.mpc.redesigned(**{x: changes[x] for x in changes if x not in names})
        if not names.keys() & changes:
            return replace(self, mpc=mpc)
        old = {x: dict(zip(names[x], getattr(self, x).tolist(), strict=True)) for x in names}
        new = {x: changes.get(x, {}) for x in names}
        new = {x: {**old[x], **v} if isinstance(v, Mapping) else v for x, v in new.items()}
        return Law.of(mpc, **new)

    def begun(self, u: Array | None = None, rests: bool = False) -> Memory:
        """Return a memory without a past, with the last input u, by default zero, in its bounds.

        Unless it ``rests``, the plant is in any state of the log, if there is one.
        """
        last = np.clip(0.0 if u is None else u, *self.design.u_bounds)
        steps = len(self.observer.gains) - 1 if rests else 0
        runs = np.where(last > self.switches, LONG, -LONG) if self.design.levels else None
        return Memory(last, rest=(None, None if u is None else last), steps=steps, runs=runs)

    def estimates(self, memory: Memory) -> tuple[Array, Array]:
        """Return the predictions of x and w, zero before the first step."""
        e = np.zeros(len(self.observer.F)) if memory.e is None else memory.e
        return e[: len(self.design.plant.A)], e[len(self.design.plant.A) :]

    def step(self, memory: Memory, y: Array, r: Array, known: Array) -> Move:
        """Return the input for the `Signals` of a step: the last one if there is no plan.

        It raises for no value of them, so that the estimates go on.
        """
        design, n = self.design, len(self.design.plant.A)
        watching = self.at(memory.e, memory.u, memory.known)
        memory, e, status = watching._seen(memory, y, known)
        if valid := self._are_plausible(r, 0).all():
            memory = memory._replace(r=r[:1] if design.references == "held" else r)
        if e is None or status == Outcome.INVALID or not valid:
            return self._held(memory, e, Outcome.INVALID)
        try:
            law, target = watching.aimed(r, known, e[n:])
        except SolverError:
            return self._held(memory, e, Outcome.INFEASIBLE)
        p = law.design.arranged(np, e[:n], target, memory.u, known)
        plan, ahead = law._planned(p, memory, target, known, e[n:])
        memory = memory._replace(ahead=ahead)
        if (found := plan.status[0]) and found != Status.NODE_LIMIT:
            status = Outcome.INFEASIBLE if found == Status.INFEASIBLE else Outcome.LIMIT
            return law._held(memory, e, status)
        u_s, moved = target.u[-1] if design.staged else target.u, plan.z[0, len(p) :]
        u = self._within(u_s + moved[: len(u_s)], memory, on_levels=True)
        memory = self._after(memory, e, u)
        return Move(u, memory, Outcome.NODE_LIMIT if found else status, law, target, p, plan)

    @cached_property
    def loads(self) -> Array:
        """The map of w to what a nonlinear plant's inputs have besides u, ``(m, n_w)``."""
        names, inputs = self.design.disturbances.names, self.design.plant.inputs
        return np.array([[x == f"{PREFIX}{name}" for x in names] for name in inputs])

    def at(self, e: Array | None, u: Array, d: Array | None, aims: bool = False) -> Law:
        """Return the law of a nonlinear plant linearised at a point: its filter, or ``aims``, too.

        It is this law if the plant is linear, the point unknown, or without a filter or a target.
        """
        if e is None or d is None or self.design.plant.dynamics is None:
            return self
        x, w = np.split(e, [len(self.design.plant.A)])
        return self.around(np.concatenate((d, x, u + self.loads @ w)), aims)

    def around(self, point: Array, aims: bool) -> Law:
        """Return the law of a nonlinear plant linearised at a point [d; x; u]; see `at`."""
        with suppress(QPError):
            plant = self.design.plant.at(point)
            own = self.design.disturbances._replace(B=plant.B @ self.loads)
            design = replace(self.design, plant=plant, disturbances=own)
            vars(design)["scaling"] = self.design.scaling  # where inputs act on nothing, none is
            fixed = self.gain is not None
            observer = self.observer if fixed else kalman(design, self.noise, self.drift)
            mpc = LinearMPC.of_design(design, **self.mpc.options) if aims else self.mpc
            return replace(self, mpc=mpc, observer=observer)
        return self

    def aimed(self, r: Array, known: Array, w: Array) -> tuple[Law, Target]:
        """Return the target, and the law of a nonlinear plant linearised there."""
        law, target = self, self._target(r, known, w)
        for _ in range(0 if self.design.plant.dynamics is None else NEWTON):
            x, u = (np.atleast_2d(part)[-1] for part in target[:2])
            _, of_u, of_x, of_d = law.design.scaling
            off = np.concatenate((known[-1], x, u + self.loads @ w)) - law.design.plant.point
            if (np.abs(off) <= NEAR * np.concatenate((of_d, of_x, of_u))).all():
                break
            law = law.at(np.append(x, w), u, known[-1], aims=True)
            target = law._target(r, known, w)
        return law, target

    def _planned(
        self, p: Array, memory: Memory, target: Target, known: Array, w: Array
    ) -> tuple[BatchSolution, Array | None]:
        """Return the plan, and the levels that it has from the next step on, or its moves."""
        if self.design.plant.dynamics is not None:
            plan, count = self.mpc.plan, COLD if memory.ahead is None else WARM
            search = SequentialQP(self._moved(target, known, w), plan.layout, plan.gamma, count)
            start = None if memory.ahead is None else torch.from_numpy(memory.ahead)
            with torch.no_grad():
                qp, fixed = plan.quadratic_program(), torch.from_numpy(p[None])
                found = search.solve(qp, fixed, len(p) + plan.n_u, plan.solver, "mask", start)
            parts = (getattr(found, name).numpy() for name in BatchSolution._fields)
            return BatchSolution(*parts), found.later.numpy()
        if (levels := self.mpc.plan.levels) is None:
            return self.plans.solve(p[None]), None
        assert memory.runs is not None
        plan, places = levels.plan(self.plans, p[None], memory.runs, memory.ahead)
        return plan, np.append(places[:, 1:], places[:, -1:], 1)

    def _moved(self, target: Target, known: Array, w: Array) -> Callable[..., Tensor]:
        """Return the dynamics of the plan's state, which is relative to the target."""
        design, model = self.design, self.mpc.plan.scheme.model
        n, place, f = len(design.plant.A), design.places["known"], design.plant.dynamics
        f = f.folded() if isinstance(f, LearnedModel) else f
        x_s, u_s = (torch.from_numpy(np.atleast_2d(part)[-1]) for part in target[:2])
        d_s = torch.from_numpy(np.where(design.acts, known[-1], design.nominal))
        load, (A, B) = torch.from_numpy(self.loads @ w), (x[n:].mT for x in (model.A, model.B))

        def dynamics(x: Tensor, u: Tensor, *d: Tensor) -> Tensor:
            own = [d_s + part[..., place] for part in d] if len(d_s) else []
            after = f(x_s + x[..., :n], u_s + load + u, *own) - x_s
            return torch.cat((after, x @ A + u @ B), -1)

        return dynamics

    @cached_property
    def switches(self) -> Array:
        """What each input exceeds if it is on: the middle of its lowest levels, ``(m,)``."""
        levels = (self.design.levels.get(name, ()) for name in self.design.plant.inputs)
        return np.array([np.mean(own[:2]) if own else np.inf for own in levels])

    def check_runs(self, memory: Memory) -> None:
        """Raise `QPError` if a minimum time holds an input on or off, and its bounds do not."""
        lower, upper = self.design.u_bounds
        runs = np.zeros(len(lower)) if memory.runs is None else memory.runs
        for name, own in self.design.levels.items():
            i = self.design.plant.inputs.index(name)
            on, levels = runs[i] > 0, [x for x in own if lower[i] <= x <= upper[i]]
            rule = "min_on" if on else "min_off"
            left = self.design.switching[rule][i] - abs(runs[i])
            if left > 0 and all((x > self.switches[i]) != on for x in levels):
                got = f"levels {', '.join(f'{x:g}' for x in levels)} of {name}"
                want = f"one that is {rule[4:]} for {left:g} more steps, by {rule}"
                raise QPError.expected("u_bounds", got, want, "Change them then.")

    def _held(self, memory: Memory, e: Array | None, status: Outcome) -> Move:
        """Return the move of a step without a plan: the last input, within its bounds."""
        u = self._within(memory.u, memory, on_levels=True)
        memory = memory._replace(ahead=None if self.design.levels else memory.ahead)
        return Move(u, self._after(memory, e, u), status, self)

    def _target(self, r: Array, known: Array, w: Array) -> Target:
        """Return the `Target` for set-points and known signals by stage and an estimate of w."""
        design, n_y = self.design, r.shape[1]
        known = known if design.staged else known[-1:]
        s = np.empty((len(known), n_y + len(w) + known.shape[1] + 1))
        s[:, :n_y] = r if design.references == "preview" else r[0]
        s[:, n_y : n_y + len(w)] = w
        s[:, n_y + len(w) : -1] = known - design.nominal
        s[:, -1] = 1.0

        def solve(state: Array) -> tuple[Array, Array]:
            solution = self.aims.solve(state)
            if solution.status.any():
                raise SolverError("No input holds the plant within the hard bounds.")
            return solution.z, solution.lam

        target = aimed(design, np, solve, s)
        return target if design.staged else Target(*(part[0] for part in target))

    def observed(self, memory: Memory, y: Array, u: Array, known: Array) -> tuple[Memory, Outcome]:
        """Return the memory after a step in which the input u was applied, and its status.

        The last input takes the place of an implausible entry of u, and is clipped into the bounds
        afterwards: the next step moves from there.
        """
        memory, e, status = self.at(memory.e, memory.u, memory.known)._seen(memory, y, known)
        u = np.where(np.abs(u) <= self.max_plausible_u, u, memory.u)
        memory = self._after(memory, e, u)
        return memory._replace(u=self._within(u, memory)), status

    @property
    def max_plausible_u(self) -> Array:
        """The largest size of an input that was applied, ``(m,)``."""
        return ABSURD * np.maximum(largest(self.design.u_bounds), self.design.scaling.u)

    def _are_plausible(self, signals: Array, known: int) -> Array:
        """Return the mask of outputs and set-points, or known signals, that may be measurements."""
        return np.abs(signals) <= self.max_plausible[known]

    def _seen(self, memory: Memory, y: Array, known: Array) -> tuple[Memory, Array | None, Outcome]:
        """Return the memory with the known signals, the estimate corrected by y, and the status.

        While an output is missing, the covariance of the estimates grows, and the gains with it.
        Instead of rows of known signals with an implausible entry the last ones hold.
        """
        seen, valid = self._are_plausible(y, 0), self._are_plausible(known, 1).all()
        every, observer, e, P = seen.all(), self.observer, memory.e, memory.P
        taken = known[0] if valid else memory.known
        if e is None and not (valid and every):
            return memory._replace(known=taken), None, Outcome.INVALID
        last = len(observer.gains) - 1
        k = min(memory.steps, last)  # another model, or a file of another machine, had more
        if e is None:
            e = observer.start if k < last else self.rested(memory.u, known[0], y)
        gain, error = observer.gains[k], y - observer.H @ e
        if P is not None or not every:
            gain, P = observer.corrected(observer.spread(k) if P is None else P, seen)
            error = np.where(seen, error, 0.0)
        k = last if P is not None else min(k + 1, last)
        status = Outcome.SOLVED if every else Outcome.MISSING
        memory = memory._replace(known=taken, steps=k, P=P)
        return memory, e + gain @ error, status if valid else Outcome.INVALID

    def _after(self, memory: Memory, e: Array | None, u: Array) -> Memory:
        """Return the memory after a step with the input u."""
        if e is not None:
            assert memory.known is not None
            e = self.predicted(e, u, memory.known)
        if (runs := memory.runs) is not None:
            on = u > self.switches
            runs = np.where(on, np.maximum(runs, 0) + 1, np.minimum(runs, 0) - 1)
        return memory._replace(u=u, e=e, runs=runs)

    def predicted(self, e: Array, u: Array, d: Array) -> Array:
        """Return the e after e with the input u and the known signals d."""
        after, plant = self.observer.predicted(e, u, d), self.design.plant
        if plant.dynamics is not None:
            x, w = np.split(e, [len(plant.A)])
            x = plant.after(x, u + self.loads @ w, d)
            after[: len(x)] = np.where(np.isfinite(x).all(), x, after[: len(x)])
        return after

    def rested(self, u: Array, d: Array, y: Array) -> Array:
        """Return the e that rests with u, d and y."""
        plant, size = self.design.plant, self.design.scaling.x
        if plant.dynamics is None:
            return self.observer.at_rest(u, d, y)
        return settled(
            self.observer.at_rest(plant.point[-len(u) :], d, y),
            lambda e: self.at(e, u, d).observer.at_rest(u, d, y),
            lambda e: (self.predicted(e, u, d) - e)[: len(size)] / size,
        )

    def _within(self, u: Array, memory: Memory, on_levels: bool = False) -> Array:
        """Return inputs within their bounds, numbers before known signals, or on levels there."""
        lower, upper = self.design.u_bounds
        if memory.known is not None and self.design.limits:
            lower, upper = self.design.bounds_at(memory.known)[1]
        u = np.clip(np.clip(u, lower, upper), *self.design.u_bounds)
        for name, own in self.design.levels.items() if on_levels else ():
            i = self.design.plant.inputs.index(name)
            inside = np.array([x for x in own if lower[i] <= x <= upper[i]])
            u[i] = inside[np.abs(inside - u[i]).argmin()] if len(inside) else u[i]
        return u

    def policy(self, memory: Memory) -> Callable[[Signals], Move]:
        """Return `step` as a function that keeps its own memory."""
        law = self

        def policy(signals: Signals) -> Move:
            nonlocal law, memory
            move = law.step(memory, *signals)
            law, memory = move.law, move.memory
            return move

        return policy

    def read_known(
        self, known: Any, rows: int, least: int | None = None, sane: bool = True
    ) -> Array:
        """`read` known signals from one row or at least ``least``, by default all."""
        if known is None and (names := self.design.plant.known):
            remedy = "Pass a forecast of N + 1 rows, or one row that is held; an environment has "
            remedy += "it in info['known']."
            raise QPError.expected("known", "None", f"the signals {', '.join(names)}", remedy)
        return self.read("known", known, rows, rows if least is None else least, sane)

    def read_set_points(self, r: Any, rows: int, last: Array, sane: bool = True) -> Array:
        """`read` set-points, by default the ``last`` ones.

        Of outputs without a weight, which need none, they are zero if left out or implausible.
        """
        outputs = self.design.plant.outputs
        if r is None and not len(last) and self.design.Q.any():
            want = f"set-points of {', '.join(outputs)}"
            raise QPError.expected("r", "None before any valid set-point", want)
        r = (last if len(last) else np.zeros(len(outputs))) if r is None else by_name(r)
        unweighted = {*range(len(outputs))} - {*self.design.weighted}
        if isinstance(r, Mapping):
            r = {**dict.fromkeys([outputs[i] for i in unweighted], 0.0), **r}
        table = self.read("r", r, rows, sane=sane)
        for i in unweighted:
            table[:, i] = np.where(self._are_plausible(table, 0)[:, i], table[:, i], 0.0)
        return table

    def read(self, name: str, value: Any, rows: int, least: int = 1, sane: bool = True) -> Array:
        """Return rows of y, r or known signals, ``(rows, n)``.

        Raises:
            QPError: they are missing, a name or shape is wrong, or (if they must be ``sane``) a
                number is not finite or above `max_plausible`.
        """
        plant, known = self.design.plant, name == "known"
        names = plant.known if known else plant.outputs
        table, most = read_table(name, value, names, rows, least, sane), self.max_plausible[known]
        if sane and (above := np.abs(table) > most).any():
            k, i = np.argwhere(above)[0]
            got, want = f"{table[k, i]:g} of {names[i]}", f"at most {most[i]:.3g} in size"
            remedy = f"If it is no error, measure {names[i]} in a larger unit."
            raise QPError.expected(name, got, want, remedy)
        return table


def settled(x: Array, step: Callable[[Array], Array], off: Callable[[Array], Array]) -> Array:
    """Return the x after Newton's method, whose ``step`` is shortened until x is less ``off``."""
    shares = np.array([0.0, 1.0, 0.5, 0.25, 0.1])
    with suppress(QPError):  # no slope there
        for _ in range(NEWTON):
            tries = x + shares[:, None] * (step(x) - x)
            sizes = np.array([np.abs(off(z)).max() for z in tries]) / (1 - shares / 2)
            x = tries[np.nan_to_num(sizes, nan=np.inf).argmin()]
    return x


def _deviations(name: str, value: Any, default: Array, names: tuple[str, ...]) -> Array:
    """Read standard deviations, which must be positive; None asks for the default."""
    said = read_said(name, value, names)
    vector = np.array([said.get(key, x) for key, x in zip(names, default, strict=True)])
    if not ((vector > 0) & np.isfinite(vector)).all():
        got = ", ".join(f"{x:g} of {key}" for key, x in zip(names, vector, strict=True))
        raise QPError.expected(name, got, "a standard deviation > 0 of each")
    return vector
