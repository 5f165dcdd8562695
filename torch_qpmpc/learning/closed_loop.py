"""Theta by gradients through closed loops: `improve`.

The mean cost of closed loops of a plant that torch can simulate is a function of theta, and its
gradient goes through the policy's QP, the plant and the filter, step by step. Agrawal, Barratt,
Boyd and Stellato (2020, arXiv 1912.09529) tune convex policies by it; Zuliani, Balta and Lygeros
(2023, arXiv 2312.15521) call it BP-MPC, and prove convergence with conservative Jacobians. Here the
plant may be a model that a log identified, with its noise and filter.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy  # imports its parts at their first use
import torch
from torch import Tensor, nn
from torch.autograd import grad
from torch.optim.lr_scheduler import LinearLR

from torch_qpmpc.checks import POSITIVE, check_kind, check_number, check_seed, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.identification import Identified
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.log import Trajectory, folds
from torch_qpmpc.identification.subspace import each, fit_state_space, signals
from torch_qpmpc.learning.gate import FEWEST, PairedTest
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.parametrizations import Tied, make_hessian
from torch_qpmpc.mpc.scheme import Scheme
from torch_qpmpc.mpc.validation import check_no_levels

#: The steps of a loop whose gains differ from the last one's, at most.
STEPS = 1000
#: The methods that a plant needs.
METHODS = ("starts", "draw", "noise", "step", "cost")
#: The level of the test of noise that grows.
LEVEL = 0.01
#: The least share of innovations at rest that moves the state.
LEAST = 0.01
#: Models of an ensemble, every THIRD of which trains theta.
MEMBERS, THIRD = 12, 3
#: The least steps of a piece of a log, in lags of its model and one; the most draws of a member.
PIECE, DRAWS = 4, 10
#: Loops that decide are this many times as long as those of the gradients.
LONGER = 4
#: A loop that sees signals this many times as large as the first ones has failed.
LOST = 1e6


class SimulatedPlant:
    """Identified models as a plant whose policy sees the estimate of a filter.

    Loop i runs with model i modulo their number. The state is [xi, xi_f, y, k, first]: the model's
    own, which its innovations move, the filter's estimate, the output, the step, by which the gains
    vary, and the row of known signals at step zero. The innovations are drawn from those of the
    log, scaled to the model's covariance and its `growth` with the state and the action; where they
    grow, the sensor's part is drawn apart: it does not grow, nor does it move the state.

    Loops start as the log's trajectories did or, with known signals, at its steps, from the
    estimates there; the signals go on as logged, and hold their last row.

    ``observer`` is the model of the filter, and ``cost`` maps p ``(count, n_p)`` and actions
    ``(count, n_u)`` to costs ``(count,)``. p has the known signals of ``horizon`` steps ahead.

    Attributes:
        members: the number of models.
        unseen: the plant whose loops decide; see `crossed`.
    """

    unseen: SimulatedPlant

    def __init__(
        self,
        models: Sequence[Innovations],
        observer: Innovations,
        log: Sequence[Trajectory],
        cost: Callable[[Tensor, Tensor], Tensor],
        horizon: int = 0,
    ) -> None:
        self._own, self._filter, self._cost = _Course(models), _Course([observer]), cost
        self.members = len(models)
        seen = [filtered(model, log) for model in (*models, observer)]
        self._d, self._u = (torch.cat(parts) for parts in ([x.d for x in log], [x.u for x in log]))
        steps = torch.tensor([one.steps for one in log])
        self._first = (steps.cumsum(0) - steps).repeat_interleave(steps)
        self._last = (steps.cumsum(0) - 1).repeat_interleave(steps)
        last = (torch.arange(len(self._u)) - 1).maximum(self._first).numpy()
        parts = (_noise(*own, self._u.numpy(), last) for own in zip(models, seen, strict=False))
        self._residuals, self._growth, self._own.sensor = map(torch.stack, zip(*parts, strict=True))
        self._horizon, n_y = horizon, self._residuals.shape[-1]
        self._sizes = [self._own.A.shape[-1], self._filter.A.shape[-1], n_y, 1, 1]
        self._seen = _stacked([x for x, _ in seen])
        self._y = torch.cat([x.y[:-1] for x in log])
        self._rows = torch.arange(len(self._d))  # where loops start, if from the log
        self._from_log = self._d.shape[1] > 0

    def starts(self, rng: torch.Generator, count: int) -> Tensor:
        """Draw states ``(count, n_s)`` after the first output."""
        one = torch.arange(count) % self.members
        if self._from_log:
            row = self._rows[torch.randint(len(self._rows), (count,), generator=rng)]
            x, seen = self._seen[one, row, : self._sizes[0]], self._seen[-1, row, : self._sizes[1]]
            y = torch.where(self._y[row].isfinite(), self._y[row], self._own.at("C", x))
            k = torch.stack((row - self._first[row], self._first[row]), -1)
            return torch.cat((x, seen, y, k.to(x)), -1)
        x, seen = self._own.x0[one], self._filter.x0.expand(count, -1)
        nu = torch.randn(count, 2 * self._sizes[2], generator=rng, dtype=x.dtype)
        return self._measured(x, seen, nu, x.new_ones(1), torch.zeros(count, 2).long())

    def known(self, s: Tensor) -> Tensor:
        """Return what the policy sees, p ``(count, n_p)``."""
        return torch.cat((self._ahead(s, self._horizon).flatten(1), self._parts(s)[1]), -1)

    def _parts(self, s: Tensor) -> tuple[Tensor, ...]:
        return s.split(self._sizes, -1)

    def _row(self, s: Tensor, ahead: int = 0) -> Tensor:
        """Return the rows of the log's signals now and ``ahead``, ``(count, ahead + 1)``."""
        k, first = s.detach()[:, -2:].long().split(1, -1)
        return (first + k + torch.arange(ahead + 1)).minimum(self._last[first])

    def _ahead(self, s: Tensor, ahead: int = 0) -> Tensor:
        """Return the known signals now and ``ahead``, ``(count, ahead + 1, n_d)``."""
        n_d = self._d.shape[1]
        return self._d[self._row(s, ahead)] if n_d else s.new_zeros(len(s), ahead + 1, 0)

    def draw(self, rng: torch.Generator, count: int) -> Tensor:
        """Draw innovations and the sensor's noise, of unit covariance, ``(count, 2 n_y)``."""
        chosen = torch.randint(self._residuals.shape[1], (2, count), generator=rng)
        return torch.cat([*self._residuals[torch.arange(count) % self.members, chosen]], -1)

    def noise(self, nu: Tensor, draw: Tensor) -> Tensor:
        """Return the draw, as innovations are white."""
        return draw

    def step(self, s: Tensor, a: Tensor, nu: Tensor) -> Tensor:
        """Return the next states."""
        own, (x, seen, *_), d = self._own, self._parts(s), self._ahead(s)[:, 0]
        k = s.detach()[:, -2:].long() + torch.tensor([1, 0])
        squares = torch.cat((x.new_ones(len(x), 1), x.square(), a.square()), -1)
        growth = self._growth[torch.arange(len(x)) % self.members]
        size = (growth @ squares[..., None])[..., 0].sqrt()
        return self._measured(own.moved(x, a, d), self._filter.moved(seen, a, d), nu, size, k)

    def cost(self, s: Tensor, a: Tensor) -> Tensor:
        """Return the costs of a step, ``(count,)``."""
        return self._cost(self.known(s), a)

    def _measured(self, x: Tensor, seen: Tensor, nu: Tensor, size: Tensor, k: Tensor) -> Tensor:
        """Return the states after an output, from their predictions."""
        own, other, (e, v) = self._own, self._filter, nu.chunk(2, -1)
        e = own.at("roots", e, k[:, 0]) * size
        y = own.at("C", x) + e + own.at("sensor", v)
        x = x + own.at("gains", e, k[:, 0])
        seen = seen + other.at("gains", y - other.at("C", seen), k[:, 0])
        return torch.cat((x, seen, y, k.to(x)), -1)


class _Course:
    """Matrices of models, and the gains and the roots of innovations' covariances by step.

    All have as many states and steps as the largest, states that stay zero and steady gains.
    """

    def __init__(self, models: Sequence[Innovations]) -> None:
        names = "A", "B", "E", "offset", "C", "x0"
        parts = ([getattr(x, name) for x in models] for name in names)
        self.A, self.B, self.E, self.offset, self.C, self.x0 = map(_stacked, parts)
        runs = [model.settling(STEPS) for model in models]
        rows = np.arange(max(len(gains) for gains, _ in runs) + 1)
        gains, roots = [], []
        for model, (L, V) in zip(models, runs, strict=True):
            gains.append(np.concatenate((L, model.L[None]))[np.minimum(rows, len(L))])
            V = np.concatenate((V, model.S[None]))
            roots.append(np.array([_root(x) for x in V])[np.minimum(rows, len(L))])
        self.gains, self.roots, self.sensor = _stacked(gains), _stacked(roots), torch.empty(0)

    def at(self, name: str, x: Tensor, k: Tensor | None = None) -> Tensor:
        """Return the product of each loop's matrix, that of step k, and x ``(count, n)``."""
        whole = getattr(self, name)
        one = torch.arange(len(x)) % len(whole)
        chosen = whole[one] if k is None else whole[one, k.clamp(max=whole.shape[1] - 1)]
        return (chosen @ x[..., None])[..., 0]

    def moved(self, x: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """Return the predictions of the next states."""
        offset = self.offset[torch.arange(len(x)) % len(self.offset)]
        x = self.at("A", x) + self.at("B", u) + offset
        return x + self.at("E", d) if d.shape[1] else x


def _stacked(parts: Sequence[np.ndarray]) -> Tensor:
    """Stack arrays, the smaller ones with zeros at their ends."""
    sizes = np.max([x.shape for x in parts], 0)
    return torch.as_tensor(np.array([np.pad(x, [(0, n) for n in sizes - x.shape]) for x in parts]))


def _root(V: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(V)
    return vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T


def simulated_plant(
    identified: Identified, cost: Callable, horizon: int, members: int = MEMBERS, seed: int = 0
) -> SimulatedPlant:
    """Return the `ensemble` of a model as `crossed` plants, with its filter."""
    log, slow = identified.log.trajectories, len(identified.model.A) > len(identified.fit.model.A)
    models = [x.disturbed() if slow else x for x in ensemble(identified, members, seed)]
    return crossed(models, lambda part: SimulatedPlant(part, models[0], log, cost, horizon))


def crossed(
    models: list[Innovations], make: Callable[[list[Innovations]], SimulatedPlant]
) -> SimulatedPlant:
    """Return a plant of every third model, with one of the others as its ``unseen``."""
    plant, others = make(models[::THIRD]), [x for i, x in enumerate(models) if i % THIRD]
    plant.unseen = make(others) if others else plant
    return plant


def ensemble(identified: Identified, members: int, seed: int) -> list[Innovations]:
    """Return a model, and those of its trajectories or pieces of one, drawn with replacement."""
    log, fit = identified.log.trajectories, identified.fit
    if len(log) == 1:
        pieces = min(members, log[0].steps // (PIECE * (1 + fit.lags)))
        log = [part for (part,) in folds(log, max(pieces, 1))]
    rng, models = np.random.default_rng(seed), [fit.model]
    for rows in rng.integers(len(log), size=(DRAWS * members, len(log))):
        if len(models) == members or len(log) == 1:
            break
        with suppress(QPError):  # of trajectories that are too short
            models.append(fit_state_space([log[i] for i in rows], fit.order, fit.lags).model)
    return models


def filtered(model: Innovations, log: Sequence[Trajectory]) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates ``(steps, n)`` of a log, and the innovations that follow them."""

    def both(y: np.ndarray, u: np.ndarray, d: np.ndarray) -> Iterator[Any]:
        return zip(model.estimates(y, u, d)[:, :-1], model.errors(y, u, d, 1)[:, :, 0], strict=True)

    x, e = zip(*each(model, signals(log), both), strict=True)
    return np.concatenate(x), np.concatenate(e)


def _noise(
    model: Innovations, seen: tuple[np.ndarray, np.ndarray], u: np.ndarray, last: np.ndarray
) -> tuple[Tensor, Tensor, Tensor]:
    """Return innovations in unit covariance, their variances' `growth`, and the sensor's root.

    With R = (I - C L) S of the sensor, whose noise moves the estimate, too, R + (C A L) R (C A L)'
    of S are its, but no more than S has at rest. Constant noise may as well move the state.
    """
    (x, e), (A, B, E, _, C, L, S, *_) = seen, model
    moves = np.hstack((A - np.diag(A.diagonal()), B, E)).any(1)  # others are slow disturbances
    v = np.hstack((x * moves, u))
    v = np.hstack((v, v[last]))  # noise on hidden states shows in outputs a step later
    known = np.isfinite(e).all(1)
    e, v = e[known] - e[known].mean(0), v[known]
    c = growth(e, v)
    e = e / np.sqrt(np.hstack((np.ones((len(v), 1)), v**2)) @ c.T)
    e = e @ np.linalg.pinv(_root(e.T @ e / len(e)), 1e-9, True)
    c = np.hstack((c[:, :1], c[:, 1:].reshape(len(c), 2, -1).sum(1)))
    grows = c[:, 1:].any(1)
    R, K = (S - C @ L @ S) * np.outer(grows, grows), C @ A @ L
    root, size = _root((R + R.T) / 2), np.where(grows, np.diag(S), np.inf)
    share = np.square(np.hstack((root, K @ root))).sum(1) / size
    c[:, 0] -= (part := np.minimum(share, (1 - LEAST) * c[:, 0]))
    root *= np.sqrt(part / np.where(share > 0, share, 1.0))[:, None]
    return torch.as_tensor(e), torch.as_tensor(c), torch.as_tensor(root)


def growth(e: np.ndarray, v: np.ndarray) -> np.ndarray:
    r"""Return how the variances of innovations grow with states and actions.

    The variance of an entry of the innovations e ``(m, n_y)`` after states and actions v ``(m, n)``
    is the mean one times ``c_0 + sum_i c_i v_i^2``. The c ``(n_y, 1 + n)`` have the most likelihood
    where a likelihood-ratio test of 1 % rejects a constant variance, else c_0 = 1. The statistic is
    divided by (kurtosis - 1) / 2, which makes it right for other distributions than the normal one.
    """
    m, n = v.shape
    sizes = np.concatenate(([1.0], (v**2).mean(0)))
    sizes[sizes == 0] = np.inf
    X = np.hstack((np.ones((m, 1)), v**2)) / sizes
    c = np.eye(1, 1 + n).repeat(e.shape[1], 0)
    for i, squares in enumerate((e**2).T):
        if not (mean := squares.mean()) > 0:
            continue
        squares = squares / mean

        def loss(z: np.ndarray, squares: np.ndarray = squares) -> tuple[float, np.ndarray]:
            variance = X @ np.exp(z)
            slope = (1 - squares / variance) / variance
            return (np.log(variance) + squares / variance).sum(), np.exp(z) * (slope @ X)

        start = np.full(1 + n, -np.log(1 + n))
        fit = scipy.optimize.minimize(loss, start, jac=True, bounds=[(-20, 5)] * (1 + n))
        statistic = (m - fit.fun) / ((squares**2).mean() - 1) * 2
        if scipy.special.chdtrc(n, max(statistic, 0.0)) < LEVEL:
            c[i] = np.exp(fit.x) / sizes
    return c


def stage_cost(scheme: Scheme) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the cost of (p, u_0) in a scheme's first stage, with the price of its soft bounds."""
    layout, theta = scheme.layout, scheme.theta
    parts = (0, layout.n_d), (layout.n_preview, layout.n_p + layout.n_u)
    kept = torch.cat([torch.arange(*part) for part in parts])
    one = torch.ones(layout.n_z, dtype=torch.float64)
    H = make_hessian(layout, scheme.cost.hessian, theta["H"], theta["H_f"], one)[kept][:, kept]
    q = theta["q"][kept]
    G, lb, ub, w = (theta[name] for name in ("G", "lb", "ub", "w"))
    others = torch.ones(layout.n_z, dtype=torch.bool).index_fill(0, kept, False)
    rows = w.isfinite() & ~(G[:, others] != 0).any(1)
    G, lb, ub, w = G[rows][:, kept], lb[rows], ub[rows], w[rows]

    def cost(p: Tensor, u: Tensor) -> Tensor:
        v = torch.cat((p, u), -1)[:, kept]
        outside = (lb - v @ G.mT).relu() + (v @ G.mT - ub).relu()
        return (v @ H * v).sum(-1) / 2 + v @ q + outside @ w

    return cost


class _Steps(NamedTuple):
    """Steps of closed loops, each ``(steps, count, ..)``."""

    states: Tensor
    known: Tensor
    actions: Tensor
    active: Tensor
    noise: Tensor
    costs: Tensor


class _Loops:
    """Closed loops with a plant, side by side, that can go on."""

    def __init__(self, plant: Any, count: int, seed: int) -> None:
        self._plant, self._count, self._rng = plant, count, torch.Generator()
        self._known = getattr(plant, "known", lambda s: s)
        self.start(seed)

    def start(self, seed: int | None = None) -> None:
        """Begin at new first states, with the noise of a seed or as it goes on."""
        if seed is not None:
            self._rng.manual_seed(seed)
        self._s, self.done = self._plant.starts(self._rng, self._count), 0
        self._far = LOST * max(self._known(self._s).abs().max().item(), 1.0)
        self._nu = torch.zeros_like(self._s)

    @torch.no_grad()
    def run(self, mpc: QPMPC, steps: int) -> _Steps:
        """Return the next steps."""
        plant, s, done = self._plant, self._s, []
        qp, active = mpc.quadratic_program(), None
        for _ in range(steps):
            p = self._known(s)
            a, active = mpc.policy_and_active_set(p, active, qp)
            a = torch.where((p.abs() > self._far).any(-1, keepdim=True), torch.nan, a)
            self._nu = plant.noise(self._nu, plant.draw(self._rng, self._count))
            done.append(_Steps(s, p, a, active, self._nu, plant.cost(s, a)))
            s = plant.step(s, a, self._nu)
        self._s, self.done = s, self.done + steps
        return _Steps(*map(torch.stack, zip(*done, strict=True)))

    def mean_cost(self, mpc: QPMPC, steps: int) -> Tensor:
        """Return the mean cost of the next steps, with its gradient in theta if it is finite.

        Theta acts on the loops by their actions alone. The chain through the plant goes backwards
        in time and gives each action the slope of the mean cost in it; all QPs are differentiated
        at once.
        """
        taken = self.run(mpc, steps)
        mean = taken.costs.mean()
        if not mean.isfinite():
            return mean
        known = taken.known.requires_grad_()
        actions = mpc.policy(known, taken.active)
        rows = (grad(u.sum(), known, retain_graph=True)[0] for u in actions.unbind(-1))
        gains = torch.stack([*rows], -2)
        share = torch.full_like(taken.costs[0], 1 / taken.costs.numel())
        slope, slopes = torch.zeros_like(self._s), torch.empty_like(taken.actions)
        for k in range(steps - 1, -1, -1):
            s, a = taken.states[k].requires_grad_(), taken.actions[k].requires_grad_()
            ends = self._plant.cost(s, a), self._plant.step(s, a, taken.noise[k])
            direct, slopes[k] = grad(ends, (s, a), (share, slope), materialize_grads=True)
            through = (slopes[k][:, None] @ gains[k])[:, 0]
            slope = direct + grad(self._known(s), s, through)[0]
        linear = (actions * slopes).sum()
        return mean + (linear - linear.detach())


@dataclass(frozen=True)
class Improvement:
    """The outcome of `improve`; ``print`` shows it.

    Attributes:
        kept: True if theta has changed.
        before, after: the mean cost of a step in held-out loops, with the old and the new theta.
        interval: the 95 % confidence interval of the mean difference.
        loops, steps: the number of held-out loops, and their length.
        curve: the mean cost of a step in the loops of each update.
        gained, models: the number of models with which the new theta costs less, and of all that
            decide.
        notes: sentences about what was held, and why.
    """

    kept: bool
    before: float
    after: float
    interval: tuple[float, float]
    loops: int
    steps: int
    curve: list[float]
    gained: int
    models: int
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        verdict = "kept" if self.kept else "not kept, theta is as before"
        low, high = self.interval
        first = (
            f"{verdict}: cost of a step {self.before:.4g} -> {self.after:.4g} in {self.loops} "
            f"held-out loops of {self.steps} steps, difference in [{low:.3g}, {high:.3g}] with 95 %"
        )
        models = f"It costs less with {self.gained} of {self.models} models that did not train it."
        return "\n".join((first, *[models] * (self.models > 1), *self.notes))


def improve(
    mpc: QPMPC,
    plant: Any,
    *,
    updates: int = 100,
    loops: int = 32,
    steps: int = 100,
    window: int | None = None,
    rate: float = 0.05,
    held_out: int = 256,
    members: int = MEMBERS,
    cost: Callable[[Tensor, Tensor], Tensor] | None = None,
    penalty: Callable[[QPMPC], Tensor] | None = None,
    seed: int = 0,
) -> Improvement:
    """Move theta along the gradient of the cost of closed loops, and keep it if they cost less.

    The loss is the undiscounted mean cost of a step. Adam moves the learned parts of ``mpc`` at a
    rate that falls to zero; the signals of the first loops set the unit of each entry. The new
    theta is kept if `PairedTest` finds that it costs less in unseen loops of four times the
    ``steps``, and one more model would agree with 95 %; otherwise ``mpc`` stays as it was. A third
    of an identified plant's models trains theta, and the others decide. A loop in which a QP has no
    certified solution, or whose signals grow a million times, costs infinity and skips its update.

    Args:
        mpc: the policy, with its own ``learn`` and ``structure``; its dynamics are held.
        plant: an `Identified` model, whose filter's estimate is the QP's state; or a plant with
            ``starts(rng, count)``, ``draw(rng, count)``, ``noise(nu, draw)``, ``step(s, a, nu)``
            and ``cost(s, a)`` of a `torch_qpmpc.envs.LinearSystem`, differentiable in s and a. A
            method ``known(s)`` says what the policy sees, if it is not s.
        updates: the number of gradients.
        loops, steps: the number of loops side by side, and their length.
        window: steps of one gradient, after which the loops go on; ``steps`` by default.
        rate: the first rate of Adam, in units of the signals.
        held_out: the number of loops that decide, at least two with each model.
        members: the number of models of an identified plant: the log's, and others of trajectories
            drawn with replacement, or of pieces of a single one.
        cost: maps p ``(count, n_p)`` and u ``(count, n_u)`` to the costs of a step of an identified
            plant; by default the `stage_cost` of the scheme.
        penalty: maps ``mpc`` to a term that is added to the mean cost of a step, such as
            ``lambda mpc: DeviationPenalty(mpc)(mpc.C)``.
        seed: seeds the models and the loops.

    Raises:
        QPError: an argument is invalid, or ``mpc`` learns nothing.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> plant, limits = qm.envs.PointMass(), ([-1.0] * 2, [1.0] * 2)
        >>> weight = torch.tensor([0.1] * 4 + [10.0] * 2)
        >>> mpc = qm.QPMPC.from_model(
        ...     plant.A, plant.B, 5, stage_weight=weight, action_bounds=limits, solver="daqp"
        ... )
        >>> report = qm.improve(mpc, plant, updates=5, steps=30)
        >>> report.kept, report.after < report.before
        (True, True)
    """
    check_kind("mpc", mpc, QPMPC)
    check_no_levels(mpc, "gradients of closed loops")
    window = steps if window is None else window
    own = {"updates": updates, "loops": loops, "steps": steps, "window": window, "members": members}
    for name, size in own.items():
        check_whole(name, size, 1)
    check_number("rate", rate, *POSITIVE)
    check_seed(seed)
    for name, function in {"cost": cost, "penalty": penalty}.items():
        if not (function is None or callable(function)):
            raise QPError.expected(name, type(function).__name__, "a function, or None")
    if isinstance(plant, Identified):
        plant = simulated_plant(plant, cost or stage_cost(mpc.scheme), mpc.horizon, members, seed)
    elif cost is not None or members != MEMBERS:
        raise QPError.expected("cost, members", "other ones", "the plant's own, by their defaults")
    if missing := [name for name in METHODS if not callable(getattr(plant, name, None))]:
        got = f"{type(plant).__name__}, without {', '.join(missing)}"
        raise QPError.expected("plant", got, "an identified model, or a LinearSystem's methods")
    seeds = [int(x) for x in np.random.SeedSequence(seed).generate_state(2)]
    before, on_failure = copy.deepcopy(mpc.state_dict()), mpc.on_failure
    unseen, longer = getattr(plant, "unseen", plant), LONGER * steps
    members = getattr(unseen, "members", 1)
    check_whole("held_out", held_out, max(FEWEST, 2 * members))

    def tried() -> Tensor:
        return _Loops(unseen, held_out, seeds[0]).run(mpc, longer).costs.mean(0)

    mpc.on_failure, curve, kept = "mask", [], False
    try:
        descent = Descent(mpc, plant, loops, steps, window, rate, seeds[1])
        old = tried()
        schedule = LinearLR(descent.optimizer, 1.0, 1 / updates, updates)
        for _ in range(updates):
            curve.append(descent.update(penalty).item())
            schedule.step()
        old, new = (x.nan_to_num(torch.inf, torch.inf) for x in (old, tried()))
        difference = (new - old).nan_to_num(0.0, torch.inf, -torch.inf)  # where both fail they tie
        test = PairedTest()
        test.add(difference)
        means = torch.stack([x[i::members].mean() for x in (old, new) for i in range(members)])
        olds, news = means.chunk(2)
        worst = 2 * one_more((news - olds) / (olds.abs() + news.abs()), test.alpha)
        kept = test.decision == "better" and not worst > 0
    finally:
        mpc.on_failure = on_failure
        mpc.zero_grad()
        if not kept:
            mpc.load_state_dict(before)
    ends = old.mean().item(), new.mean().item(), test.interval, held_out, longer, curve
    notes = ("In one loop it costs far more: a veto.",) * test.vetoed
    notes += (f"With one more model, as the plant is, it may cost {worst:.1%} more.",) * (worst > 0)
    return Improvement(kept, *ends, int((news < olds).sum()), members, notes)


def one_more(changes: Tensor, alpha: float) -> float:
    """Return what one more model's change exceeds with probability alpha, NaN of fewer than two."""
    d = changes[changes.isfinite()]
    variance = (d - d.mean()).square().sum() / (len(d) - 1)
    t = float(scipy.special.stdtrit(len(d) - 1, 1 - alpha))
    return (d.mean() + t * (variance * (1 + 1 / max(len(d), 1))).sqrt()).item()


class Descent:
    """Moves theta along the gradient of the mean cost of closed loops, by Adam.

    Each entry of theta's coordinates has the unit that the signals of the first loops give it, in
    which ``optimizer`` works. Arguments are as in `improve`.
    """

    def __init__(
        self, mpc: QPMPC, plant: Any, loops: int, steps: int, window: int, rate: float, seed: int
    ) -> None:
        self._mpc, self._loops = mpc, _Loops(plant, loops, 0)
        self._steps, self._window = steps, window
        leaves = {k: x for k, x in mpc.coordinates().items() if x.requires_grad and x.is_leaf}
        if not leaves:
            remedy = "Name parts of theta in its learn."
            raise QPError.expected("mpc", "one that learns nothing", "learned parts", remedy)
        taken = self._loops.run(mpc, steps)
        seen = torch.cat((taken.known, taken.actions), -1).flatten(0, 1)
        sizes = seen[seen.isfinite().all(1)].square().mean(0).sqrt().to(mpc.C_0)
        x, u, d = sizes[mpc.n_p - mpc.n_x : mpc.n_p], sizes[mpc.n_p :], sizes[: mpc.n_d]
        z = torch.cat((x, u, d))[mpc.layout.signals()]
        rows, after = (mpc.G.detach() * z).norm(dim=-1), x.repeat(mpc.horizon)
        units = {"A": x[:, None] / x, "B": x[:, None] / u, "E": x[:, None] / d}
        units |= {"C": after[:, None] / z, "b": after, "lb": rows, "ub": rows}
        units["q"] = mpc.quadratic_program().H.detach().abs() @ z
        self._leaves = list(leaves.values())
        self._units = [_unit(mpc, name, x, units.get(name)) for name, x in leaves.items()]
        self._moves = [torch.zeros_like(x) for x in self._leaves]
        self.optimizer = torch.optim.Adam(self._moves, lr=rate)
        self._loops.start(seed)

    def update(self, penalty: Callable[[QPMPC], Tensor] | None = None) -> Tensor:
        """Move theta once, if its gradient is finite; return the mean cost of a step."""
        self._mpc.zero_grad()
        mean = self._loops.mean_cost(self._mpc, self._window)
        if mean.isfinite():
            loss = mean if penalty is None else mean + penalty(self._mpc)
            (loss / abs(mean.detach())).backward()
        with torch.no_grad():
            for move, leaf, unit in zip(self._moves, self._leaves, self._units, strict=True):
                move.zero_()
                move.grad = None if leaf.grad is None else leaf.grad * unit
            if nn.utils.clip_grad_norm_(self._moves, 1.0).isfinite():
                self.optimizer.step()
            for move, leaf, unit in zip(self._moves, self._leaves, self._units, strict=True):
                leaf.add_(unit * move)
        self._mpc.project_()
        if self._loops.done >= self._steps or not mean.isfinite():
            self._loops.start()
        return mean.detach()


def _unit(mpc: QPMPC, name: str, leaf: Tensor, unit: Tensor | None) -> Tensor:
    """Return the unit of a coordinate: of a weight's factor its rows, else of other parts."""
    leaf = leaf.detach()
    if unit is None:
        dense = name in ("H", "H_f") and mpc.hessian != "diagonal"
        unit = leaf.norm(dim=-1, keepdim=True).expand_as(leaf) if dense else leaf.abs()
    elif unit.shape[-1:] != leaf.shape[-1:]:  # the entries of stages are tied
        chain: Any = mpc.get_submodule(f"parametrizations.{name}")
        unit = next(unit[part.first] for part in chain if isinstance(part, Tied))
    return torch.where(unit.isfinite(), unit, 0.0)
