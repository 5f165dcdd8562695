"""A linear MPC's design: the plant, weights, bounds and set-points, and where p has them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_choice, check_number
from torch_qpmpc.control.disturbance import PREFIX, TIE, Disturbances, Steady
from torch_qpmpc.control.scaling import Scaling, but_rounding, first, inverse, ranges
from torch_qpmpc.control.state_space import Array, StateSpace, read_vector
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.levels import DEFAULTS, hull, read_levels
from torch_qpmpc.mpc.scheme import check_keywords
from torch_qpmpc.mpc.validation import as_tensor, check_weight

#: A response above this share of those soon after decides whether an output keeps its bound.
DECIDES = 0.25
Sides = tuple[Array, Array]
#: The weights of signals by name, (lower, upper), and the price of a violation, NaN by default.
Constraint = tuple[dict[str, float], tuple[float, float], float]
#: The default price of a violation by an output's size, relative to a typical stage's cost.
Y_SLACK = 1e3


class Target(NamedTuple):
    """Steady states: x_s ``(*batch, n)``, u_s ``(*batch, m)`` and y_s ``(*batch, n_y)``.

    The plan's stages weigh the set-points r ``(*batch, n_y)``, and its terminal cost ``end``, see
    `Design.end_set_points`. They are tensors, or arrays in a `Law`.
    """

    x: Any
    u: Any
    y: Any
    r: Any
    end: Any


class Bands(NamedTuple):
    """Rows ``lower <= W [y; u] + D du - K (d - nominal) <= upper``, at a ``price`` of violations.

    They have the names of their ``arguments`` of `LinearMPC` and of their signals or constraints.
    """

    arguments: Array
    names: Array
    W: Array
    D: Array
    K: Array
    lower: Array
    upper: Array
    price: Array

    def take(self, places: Any) -> Bands:
        """Return some of the rows."""
        return Bands(*(part[places] for part in self))

    def beside(self, other: Bands) -> Bands:
        """Return these rows and others."""
        return Bands(*map(np.concatenate, zip(self, other, strict=True)))

    def at(self, d: Array) -> Sides:
        """Return the bounds of ``W [y; u]`` for known signals ``(*batch, n_d)``, less nominal."""
        return self.lower + d @ self.K.T, self.upper + d @ self.K.T

    def sizes(self, y: Array, u: Array) -> Array:
        """Return the sizes of the rows for those of the outputs and inputs."""
        return np.abs(self.W) @ np.append(y, u) + np.abs(self.D) @ u


@dataclass(frozen=True, eq=False)
class Design:
    """The arguments of `LinearMPC`, read and checked, as arrays.

    Weights are ``(n_y, n_y)`` and ``(m, m)``, ``y_slack`` has the prices that are given, and
    ``u_bounds`` are within the ``levels`` of inputs, with the other arguments of `Bounds` for these
    in ``switching``. Known signals that bound an output or input from below and above are in
    ``limits`` by its name, "" on a side without one.

    Raises:
        QPError: a number is invalid, or nothing has a cost.
    """

    plant: StateSpace
    horizon: int
    Q: Array
    R: Array
    dR: Array  # noqa: N815 (the weight of du)
    y_bounds: tuple[Array, Array]
    u_bounds: tuple[Array, Array]
    du_bounds: tuple[Array, Array]
    y_slack: dict[str, float]
    linear: dict[str, str | float]
    references: str
    disturbances: Disturbances
    gamma: float
    blocks: tuple[int, ...] = ()
    limits: dict[str, tuple[str, str]] = field(default_factory=dict)
    levels: dict[str, tuple[float, ...]] = field(default_factory=dict)
    switching: dict[str, Any] = field(default_factory=dict)
    u_target: dict[str, float] = field(default_factory=dict)
    violation: dict[str, float] = field(default_factory=dict)
    constraints: dict[str, Constraint] = field(default_factory=dict)
    terminal_constraints: dict[str, Constraint] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_choice("references", self.references, ("held", "preview"))
        check_number("gamma", self.gamma, lambda x: 0 < x <= 1, "a discount factor in (0, 1]")
        zones = (self.R.any() or self.dR.any()) and self.zoned.any()
        if not (self.Q.any() or self.linear or zones):
            y, u = self.plant.outputs[0], self.plant.inputs[0]
            example = f"Q={{{y!r}: 1.0}}, dR={{{u!r}: 0.1}}"
            remedy = f"Pass one, such as {example}: (y - r)'Q(y - r) + u'R u + du'dR du."
            raise QPError.expected("Q", "no cost", "weights of the outputs", remedy)
        own = [*map(self.levels.get, self.plant.inputs)]
        bounds = hull("u_bounds", self.u_bounds, own, self.plant.inputs, self.du_bounds)
        object.__setattr__(self, "u_bounds", bounds)
        if not np.isfinite(self.resting).all():
            raise QPError.expected("u_target", f"{self.resting.tolist()}", "finite numbers")
        if (self.y_bounds[0] + self.margins[0] > self.y_bounds[1] - self.margins[1]).any():
            got = f"{self.violation}, which leaves no room between the bounds"
            raise QPError.expected("violation", got, "larger shares, or wider y_bounds")
        if any(price < 0 for price in self.y_slack.values()):
            raise QPError.expected("y_slack", self.y_slack, "prices >= 0, or inf for hard rows")

    def __str__(self) -> str:
        plant, weights = self.plant, {"Q": self.Q, "R": self.R, "dR": self.dR}
        named = plant.outputs, plant.inputs, plant.known
        y, u, d = (", ".join(map(plant.label, names)) for names in named)
        parts = [f"{y} by {u}", *([f"known {d}"] if d else []), f"horizon {self.horizon}"]
        parts += [f"{name} {np.diag(x).tolist()}" for name, x in weights.items() if x.any()]
        return "; ".join(parts)

    def merged(self, name: str, changes: Mapping[str, Any], names: Sequence[str]) -> Any:
        """Return an argument of `LinearMPC` as it is, but for those ``names`` in ``changes``.

        Weights of two signals stay with both; None removes a bound or all weights of a signal.
        """
        if isinstance(old := getattr(self, name), dict):
            return {**old, **changes}
        if name.endswith("_bounds"):
            sides = [*zip(*(side.tolist() for side in old), strict=True)]
            limited = {} if name == "du_bounds" else self.limits
            limits = [limited.get(x, ("", "")) for x in names]
            pairs = [[a or x, b or y] for (a, b), (x, y) in zip(limits, sides, strict=True)]
            return {**dict(zip(names, pairs, strict=True)), **changes}
        weight, values = old.copy(), read_vector(name, changes, names, 0.0)
        for i, value in ((names.index(x), value) for x, value in changes.items()):
            if value is None:
                weight[i] = weight[:, i] = 0.0
            weight[i, i] = values[i]
        return weight

    @property
    def moves(self) -> bool:
        """True if moves of the inputs cost or are bounded, so that p has the last input."""
        return bool(self.dR.any() or np.isfinite(self.du_bounds).any())

    @property
    def typical(self) -> float:
        """The cost of a stage that is half of the bounds' distance off the target.

        A price that is a known signal counts as one.
        """
        y, u, names = self.usual, self.scaling.u, self.plant.inputs
        prices = {k: 1.0 if isinstance(x, str) else abs(x) for k, x in self.linear.items()}
        spent = sum(price * u[names.index(name)] for name, price in prices.items())
        return float(y @ self.Q @ y + u @ (self.R + self.dR) @ u + spent)

    def prices(self, W: Array) -> Array:
        """Return the default price of violations of ``W [y; u]``: `Y_SLACK` typical stages."""
        usual = np.abs(W) @ np.append(self.usual, self.scaling.u)
        return Y_SLACK * (self.typical or 1.0) / usual

    @cached_property
    def slack(self) -> Array:
        """The prices of violations of the outputs' bounds, ``(n_y,)``."""
        default = self.prices(np.eye(len(self.Q), len(self.Q) + len(self.R))).tolist()
        pairs = zip(self.plant.outputs, default, strict=True)
        return np.array([self.y_slack.get(name, price) for name, price in pairs])

    @property
    def usual(self) -> Array:
        """Usual deviations of the outputs, ``(n_y,)``.

        They are half the distance of the bounds; without bounds those that cost one; and without a
        weight the outputs' sizes.
        """
        by_weight = first(inverse(np.sqrt(np.diag(self.Q))), self.scaling.y)
        return np.where(self.ranged, ranges(self.y_bounds), by_weight)

    @property
    def zoned(self) -> Array:
        """Mask of the outputs with a bound, ``(n_y,)``."""
        return np.asarray(np.isfinite(self.y_bounds).any(0) | (self.limited[0] >= 0).any(0))

    @cached_property
    def ranged(self) -> Array:
        """Mask of the outputs with two bounds, of which none is too far away to act, ``(n_y,)``."""
        half = ranges(self.y_bounds)
        return (half > 0) & (half <= self.scaling.y)

    @property
    def middle(self) -> Array:
        """The middle of the bounds of the outputs that are `ranged`, else zero, ``(n_y,)``."""
        return np.where(self.ranged, self.y_bounds, 0.0).mean(0)

    @cached_property
    def scaling(self) -> Scaling:
        """The sizes of the signals; a bound's is that of the signal it bounds."""
        scaling = Scaling.of(self.plant, self.y_bounds, self.u_bounds, self.Q, self.horizon)
        for size, of in zip((scaling.y, scaling.u), self.limited, strict=True):
            scaling.d[of[of >= 0]] = np.broadcast_to(size, of.shape)[of >= 0]
        return scaling

    @cached_property
    def normal(self) -> Design:
        """This design in signals divided by their sizes, without what has none."""
        y, u, x, _ = self.scaling
        w, of_w = self.disturbances, self.of_w(y)
        half = {"y_bounds": y, "u_bounds": u, "du_bounds": u}
        named = "levels", "u_target", "violation", "constraints", "terminal_constraints", "y_slack"
        return replace(
            self,
            **{name: {} for name in named},
            plant=self.scaling.plant(self.plant),
            Q=self.Q * np.outer(y, y),
            R=self.R * np.outer(u, u),
            dR=self.dR * np.outer(u, u),
            disturbances=w._replace(B=w.B * (of_w / x[:, None]), C=w.C * (of_w / y[:, None])),
            **{k: tuple(side / size for side in getattr(self, k)) for k, size in half.items()},
        )

    def of_w(self, y: Array) -> Array:
        """Return the sizes of the disturbances, ``(n_w,)``: those of their inputs, or of y."""
        plant = self.plant
        sizes = dict(zip((*plant.outputs, *plant.inputs), (*y, *self.scaling.u), strict=True))
        names = (name.removeprefix(PREFIX) for name in self.disturbances.names)
        return np.array([sizes[name] for name in names])

    @cached_property
    def steady(self) -> Steady:
        """The steady states with the disturbances."""
        weights = self.Q, self.R
        return Steady.of(self.plant, self.disturbances, *weights, self.resting, self.scaling)

    @property
    def resting(self) -> Array:
        """What inputs that r leaves free rest near, ``(m,)``: u_target, the log's mean, or zero."""
        known = {**self.plant.means, **self.u_target}
        return np.array([known.get(name, 0.0) for name in self.plant.inputs])

    @property
    def free(self) -> Array:
        """Mask of the inputs that set-points leave free, ``(m,)``."""
        moved = np.abs(self.steady.U[:, self.steady.n_a :]).max(-1, initial=0.0)
        return moved > TIE * self.scaling.u

    @cached_property
    def bands(self) -> Bands:
        """The bounds of outputs with a price, of inputs and of moves, and the constraints."""
        (_, m, n_y, n_d), inputs = self.plant.sizes, self.plant.inputs
        names = *self.plant.outputs, *inputs, *(f"move of {name}" for name in inputs)
        sides = np.hstack((self.y_bounds, self.u_bounds, self.du_bounds))
        of = np.pad(np.hstack(self.limited), ((0, 0), (0, m)), constant_values=-1)
        fixed = np.flatnonzero(np.isfinite(sides).any(0))
        side, i = np.nonzero(of >= 0)
        j, places = of[side, i], np.append(fixed, i)
        lower, upper = (
            np.append(part[fixed], np.where(side == k, self.nominal[j], limit))
            for k, (part, limit) in enumerate(zip(sides, (-np.inf, np.inf), strict=True))
        )
        low, high = np.pad(self.margins, ((0, 0), (0, 2 * m)))[:, places]
        price = np.append(self.slack, np.full(2 * m, np.inf))[places]
        kinds = np.repeat([0, 1, 2], (n_y, m, m))[places]
        unit = np.eye(len(names))[places]
        K = np.pad(np.eye(n_d)[j], ((len(fixed), 0), (0, 0)))
        parts = np.array(["y_bounds", "u_bounds", "du_bounds"])[kinds], np.array(names)[places]
        parts = *parts, unit[:, : n_y + m], unit[:, n_y + m :], K, lower + low, upper - high, price
        order = np.argsort(kinds, kind="stable")
        rows = Bands(*parts).take(order[price[order] > 0])
        return rows.beside(self.combined("constraints"))

    @cached_property
    def ends(self) -> Bands:
        """The rows of the last stage: `bands` of outputs alone, and the terminal constraints."""
        return self.bands.take(self.inner).beside(self.combined("terminal_constraints"))

    @cached_property
    def inner(self) -> Array:
        """Mask of the `bands` of outputs alone."""
        of_y, of_u = np.split(np.abs(self.bands.W), [len(self.Q)], axis=1)
        return (of_y.sum(1) > 0) & (of_u.sum(1) == 0)

    def combined(self, argument: str) -> Bands:
        """Return the rows of combinations of signals; without outputs they are hard by default."""
        own, names = getattr(self, argument), (*self.plant.outputs, *self.plant.inputs)
        W, bounds, price = zip(*own.values(), strict=True) if own else ((), (), ())
        W = np.reshape([[row.get(x, 0.0) for x in names] for row in W], (-1, len(names)))
        default = np.where(W[:, : len(self.Q)].any(1), self.prices(W), np.inf)
        price = np.where(np.isnan(price), default, price)
        parts = np.full(len(own), argument), np.array([*own], str), W
        none = (np.zeros((len(own), len(x))) for x in (self.plant.inputs, self.plant.known))
        return Bands._make((*parts, *none, *np.reshape(bounds, (-1, 2)).T, price))

    @cached_property
    def bounded(self) -> tuple[Array, Array]:
        """The places of the outputs and of the inputs that bounds and constraints have."""
        acting = np.vstack((self.bands.W, self.ends.W)).any(0)
        y, u = np.split(acting, [len(self.Q)])
        return np.flatnonzero(y), np.flatnonzero(u)

    @cached_property
    def limited(self) -> tuple[Array, Array]:
        """Places of the known signals that bound outputs and inputs, ``(2, n)``, -1 without one."""
        place = {name: i for i, name in enumerate(self.plant.known)}
        of_y, of_u = (
            [[place.get(x, -1) for x in self.limits.get(name, ("", ""))] for name in names]
            for names in (self.plant.outputs, self.plant.inputs)
        )
        return np.array(of_y).T, np.array(of_u).T

    @cached_property
    def nominal(self) -> Array:
        """What p's known signals are relative to, ``(n_d,)``.

        It is zero, and of bounds such that they leave their signals twice its size.
        """
        nominal = np.zeros(len(self.plant.known))
        bounds = zip(self.limited, self.scaling[:2], (self.y_bounds, self.u_bounds), strict=True)
        for of, size, (lower, upper) in bounds:
            ends = (
                np.where(np.isfinite(upper), upper, size) - 2 * size,
                np.where(np.isfinite(lower), lower, -size) + 2 * size,
            )
            nominal[of[of >= 0]] = np.stack(ends)[of >= 0]
        return nominal

    def answers(self, shows: float) -> Array:
        """Return each output's first step in which inputs move it their final way, 0 for none."""
        # By a part ``shows`` of the largest move of the next ten steps.
        plant, x, steps = self.normal.plant, self.normal.plant.B, []
        growth = max(1.0, np.abs(np.linalg.eigvals(plant.A)).max())
        for _ in range(max(10 * self.horizon, 200)):
            steps.append(but_rounding(plant.C @ x))
            x = plant.A @ x / growth
        sign, moves = np.sign(np.cumsum(steps, 0).round(9))[:-9], np.abs(steps)
        ahead = np.lib.stride_tricks.sliding_window_view(moves.max(2), 10, axis=0).max(-1)
        away = np.logical_and.accumulate(moves[:-9] <= shows * ahead[..., None])
        if growth < 1 + 1e-4:
            away |= (sign != sign[-1]) & (sign[-1] != 0)
        away = np.pad(away, ((1, 0), (0, 0), (0, 0)), constant_values=True)
        return (len(away) - away[::-1].argmax(0)).min(-1) % len(away)

    @cached_property
    def margins(self) -> Array:
        """How far plans stay from the lower and upper bounds of outputs, ``(2, n_y)``.

        With `violation` it is the quantile of the log's errors of predictions for the step that
        `answers`, which the next input decides. The next error exceeds it with at most that chance,
        whatever its distribution, if it is as likely as any of the log's to be the largest (Lei et
        al., "Distribution-free predictive inference for regression", JASA 113, 2018).
        """
        margins, errors = np.zeros((2, len(self.Q))), self.plant.errors
        for name, share in self.violation.items():
            i, got = self.plant.outputs.index(name), f"{share:g} of {name}"
            if not 0 < share < 1 or not (self.zoned & (self.slack > 0))[i]:
                want = "a share in (0, 1), of an output with y_bounds, or None"
                raise QPError.expected("violation", got, want)
            k = int(self.answers(DECIDES)[i])
            e = np.zeros(0) if errors is None else np.sort(errors[:, k - 1 : k, i], axis=None)
            e = e[np.isfinite(e)]
            if (place := int(np.ceil((len(e) + 1) * (1 - share)))) > len(e):
                got = f"{got}, and {len(e)} errors of the log's predictions {k} steps ahead"
                remedy = f"Pass a model of qm.identify(.., horizon={k}), or a longer log."
                raise QPError.expected("violation", got, f"{1 / share - 1:.0f} errors", remedy)
            margins[:, i] = np.maximum([-e[-place], e[place - 1]], 0.0)
        return margins

    def bounds_at(self, known: Array, kept: bool = False) -> tuple[Sides, Sides]:
        """Return the bounds of outputs and inputs where the known signals ``(*batch, n_d)`` are.

        Those of outputs that plans have ``kept`` are `margins` away.
        """
        known = np.insert(known, 0, np.nan, axis=-1)
        y, u = (
            np.where(of >= 0, known[..., of + 1], bounds)
            for of, bounds in zip(self.limited, (self.y_bounds, self.u_bounds), strict=True)
        )
        low, high = kept * self.margins
        return (y[..., 0, :] + low, y[..., 1, :] - high), (u[..., 0, :], u[..., 1, :])

    def costs(
        self, y: Tensor, r: Tensor, u: Tensor, u_s: Tensor, du: Tensor, known: Tensor
    ) -> Tensor:
        """Return the cost of each step, ``(*batch,)``; see `Run.costs`."""
        parts = (y - r, self.Q), (u - u_s, self.R), (du, self.dR)
        cost = sum(((x @ torch.as_tensor(W)) * x).sum(-1) for x, W in parts)
        for name, price in self.linear.items():
            level = known[..., self.plant.known.index(price)] if isinstance(price, str) else price
            cost = cost + level * u[..., self.plant.inputs.index(name)]
        lower, upper = map(torch.as_tensor, self.bounds_at(known.numpy())[0])
        own = self.combined("constraints")
        x = torch.cat((y, u), -1) @ torch.from_numpy(own.W.T)
        above = torch.cat((y - upper, x - torch.from_numpy(own.upper)), -1)
        below = torch.cat((lower - y, torch.from_numpy(own.lower) - x), -1)
        outside, prices = above.relu() + below.relu(), np.append(self.slack, own.price)
        sizes = np.append(self.usual, own.sizes(self.usual, self.scaling.u))
        kept = outside <= torch.from_numpy(np.where(np.isinf(prices), TIE * sizes, 0.0))
        prices = torch.where(kept, 0.0, torch.from_numpy(prices))  # inf times 0 is none
        return cost + (prices * outside).sum(-1)

    def arranged(self, arrays: Any, x: Any, target: Target, u_last: Any, known: Any) -> Any:
        """Return `LinearMPC.arrange`, for signals of one batch shape in ``torch`` or ``np`` arrays.

        They are ``(*batch, n)``, a target, with a dimension for the stages if it is `staged`,
        ``(*batch, m)`` and ``(*batch, N + 1, n_d)``.
        """
        batch, constants = x.shape[:-1], arrays.asarray(np.concatenate((self.nominal, (0.0, 1.0))))
        constants = arrays.broadcast_to(constants, (*batch, len(constants))) if batch else constants
        parts = [part.reshape(*batch, -1) for part in (x, *target, u_last, known, constants)]
        signals = arrays.concatenate(parts, -1)
        plus, minus = map(arrays.asarray, self.taken)
        return signals[..., plus] - signals[..., minus]

    @cached_property
    def differences(self) -> dict[str, tuple[Array, Array]]:
        """The places of the two signals in `arranged` whose difference p has, by name and stage."""
        n, m, n_y, n_d = self.plant.sizes
        N, rows = self.horizon + 1, self.horizon + 1 if self.staged else 1
        widths, stages = (n, n, m, *[n_y] * 3, m, n_d, n_d, 1, 1), (1, *[rows] * 5, 1, N, 1, 1, 1)
        stops = np.cumsum(np.multiply(widths, stages))
        x, x_s, u_s, y_s, r, end, u_last, known, nominal, zero, one = (
            np.arange(stop - k * width, stop).reshape(k, width)
            for k, width, stop in zip(stages, widths, stops, strict=True)
        )
        of_r, (of_y, of_u), none = self.weighted, self.bounded, (zero[:, :0], zero[:, :0])
        held, varies = self.references == "held", self.staged and self.R.any()
        return {
            "r": none if held else (r[:, of_r], y_s[-1:, of_r]),
            "u_r": (u_s, u_s[-1:]) if varies else none,
            "known": (known, np.where(self.acts, known[-1:], nominal)),
            "x": (x, x_s[-1:]),
            "u_last": (u_last, u_s[-1:]) if self.moves else none,
            "off": (y_s[-1:, of_r], r[-1:, of_r]) if held else none,
            "end": (y_s[-1:, of_r], end[-1:, of_r]) if self.pulls[1].size else none,
            "y_s": (y_s[-1:, of_y], zero),
            "u_s": (u_s[-1:, of_u], zero),
            "one": (one, zero),
        }

    @cached_property
    def taken(self) -> Array:
        """The places of all `differences`, in the order of p, ``(2, n_p)``."""
        pairs = [np.stack(np.broadcast_arrays(*pair)) for pair in self.differences.values()]
        stages = [np.broadcast_to(x, (2, self.horizon + 1, x.shape[2])) for x in pairs[:3]]
        return np.hstack((np.concatenate(stages, 2).reshape(2, -1), *(x[:, 0] for x in pairs[3:])))

    @cached_property
    def acts(self) -> Array:
        """Mask of the known signals that act on the plant, ``(n_d,)``."""
        return np.asarray(self.plant.E.any(0))

    @cached_property
    def weighted(self) -> Array:
        """The places of the outputs with a weight."""
        return np.flatnonzero(self.Q.any(0))

    def steady_state(self, arrays: Any, v: Any, s: Any, lam: Any) -> Target:
        """Return the target of v, ``s = [r; w; d; 1]`` and the target's multipliers."""
        Z, M = map(arrays.asarray, self.steady.maps)
        n, m, n_y, _ = self.plant.sizes
        r, rest = s[..., :n_y], v @ Z.T + s[..., n_y:] @ M.T
        x, u, y = rest[..., :n], rest[..., n : n + m], rest[..., n + m :]
        return Target(x, u, y, r, self.end_set_points(arrays, r, y, lam))

    @cached_property
    def pulls(self) -> tuple[Array, Array]:
        """The maps of y_s - r and of the target's last multipliers to the pull."""
        Y = self.steady.Y
        W, n_y = self.bands.W, len(Y)
        held = self.inner & (W @ np.vstack((Y, self.steady.U))).any(1)
        Y = Y[:, : self.steady.n_a]
        moved = Y @ np.linalg.pinv(Y.T @ self.Q @ Y) @ Y.T
        return moved @ self.Q, moved @ W[held, :n_y].T / 2

    def end_set_points(self, arrays: Any, r: Any, y_s: Any, lam: Any) -> Any:
        """Return the terminal cost's set-points: r, but for what bounds of outputs hold off.

        Bounds after the horizon do not act, so that the plan would leave y_s with their part of
        y_s - r. The signals are `arranged`'s, and ``lam`` ``(*batch, n_g)`` the target's.
        """
        count = self.pulls[1].shape[1]
        if not count or (arrays is np and not lam[..., -count:].any()):
            return r
        moved, shifts, Q = map(arrays.asarray, (*self.pulls, self.Q))
        own = (y_s - r) @ moved.T
        pull = own + lam[..., -count:] @ shifts.T
        size, share = ((pull @ Q * x).sum(-1)[..., None] for x in (pull, own))
        return r + own - pull * (share / arrays.where(size > 0, size, 1.0)).clip(0, 1)

    @cached_property
    def staged(self) -> bool:
        """True if a plan has targets that differ from stage to stage, for r or a weight of u."""
        varies = self.acts.any() or self.limits
        return self.references == "preview" or bool(self.R.any() and varies)

    @cached_property
    def places(self) -> dict[str, slice]:
        """The places of the signals in a stage [d_k; x_k; u_k]."""
        widths = {name: plus.shape[1] for name, (plus, _) in self.differences.items()}
        widths["u"] = len(self.R)
        ends = zip(widths.items(), np.cumsum([*widths.values()]).tolist(), strict=True)
        return {name: slice(end - width, end) for (name, width), end in ends}

    def selectors(self) -> dict[str, Array]:
        """Return the rows that read each signal from a stage [d_k; x_k; u_k]."""
        unit = np.eye(self.places["u"].stop)
        return {name: unit[place] for name, place in self.places.items()}


def read_wishes(plant: StateSpace, old: Design | None, **wishes: Any) -> dict[str, Any]:
    """Read weights and bounds by their arguments' names in `LinearMPC`, with new limits.

    A mapping leaves what it does not name as the ``old`` design has it.
    """
    y, u = plant.outputs, plant.inputs
    readers: dict[str, Any] = {"Q": (read_weight, y), "R": (read_weight, u), "dR": (read_weight, u)}
    readers |= {"y_bounds": (read_bounds, y), "u_bounds": (read_bounds, u)}
    readers |= {"du_bounds": (read_bounds, u), "y_slack": (read_said, y)}
    readers |= {"u_target": (read_said, u), "violation": (read_said, y)}
    readers["constraints"] = read_constraints, (*y, *u)
    readers["terminal_constraints"] = read_constraints, y
    check_keywords("redesign", wishes, [*readers])
    limits = {} if old is None else old.limits
    for name, value in wishes.items():
        if old is not None and isinstance(value, Mapping):
            wishes[name] = old.merged(name, value, readers[name][1])
        if name in ("y_bounds", "u_bounds"):
            names = readers[name][1]
            wishes[name], own = read_limits(name, wishes[name], names, plant)
            limits = {key: pair for key, pair in limits.items() if key not in names} | own
    read = {k: readers[k][0](k, value, readers[k][1]) for k, value in wishes.items()}
    return read | {"limits": limits}


def read_switching(u_levels: Any, plant: StateSpace, **rules: Any) -> dict[str, Any]:
    """Read levels of inputs by name, and as ``switching`` the arguments of `Bounds` for them."""
    if not isinstance(u_levels, Mapping | None) or {*(u_levels or ())} - {*plant.inputs}:
        raise QPError.expected("u_levels", repr(u_levels), f"a mapping from {[*plant.inputs]}")
    if not u_levels:
        return {"switching": rules}
    levels = dict(zip(u_levels, read_levels([*u_levels.values()], "u_levels"), strict=True))
    for name in ("min_on", "min_off", "start_cost"):
        numbers = read_vector(name, rules[name], [*levels], DEFAULTS[name])
        own = dict(zip(levels, map(float, numbers), strict=True))
        rules[name] = tuple(own.get(x, float(DEFAULTS[name])) for x in plant.inputs)
    return {"levels": {name: own for name, own in levels.items() if own}, "switching": rules}


def largest(bounds: tuple[Array, Array] | Array) -> Array:
    """Return the largest size of finite bounds, and zero where there is none."""
    return np.where(np.isfinite(bounds), np.abs(bounds), 0.0).max(0)


def read_prices(
    linear: Mapping[str, str | float] | None, plant: StateSpace
) -> dict[str, str | float]:
    """Read prices of inputs, as numbers or known signals by input."""
    want = f"a mapping from inputs {plant.inputs} to numbers or known signals {plant.known}"
    if linear is not None and not isinstance(linear, Mapping):
        raise QPError.expected("linear", repr(linear), want)
    for name, price in (linear or {}).items():
        numeric = isinstance(price, int | float | np.number) and np.isfinite(price)
        if name not in plant.inputs or not (numeric or price in plant.known):
            remedy = f"Pass known={[*plant.known, price]}." * isinstance(price, str)
            raise QPError.expected("linear", f"{{{name!r}: {price!r}}}", want, remedy)
        if not numeric:
            _check_apart("linear", str(price), plant)
    return {k: x if isinstance(x, str) else float(x) for k, x in (linear or {}).items()}


def _check_apart(name: str, signal: str, plant: StateSpace) -> None:
    """Raise `QPError` if a known signal acts on the plant: p has it less its last row."""
    if plant.E[:, plant.known.index(signal)].any():
        got, want = f"{signal!r}, which acts on the plant", "a signal with a column of zeros in E"
        raise QPError.expected(name, got, want, "Pass the signal twice.")


def signals_of(bounds: Any) -> list[str]:
    """Return the names of known signals in bounds by name or in one pair."""
    pairs = bounds.values() if isinstance(bounds, Mapping) else [bounds]
    return [x for pair in pairs if isinstance(pair, Sequence) for x in pair if isinstance(x, str)]


def read_limits(
    name: str, bounds: Any, names: Sequence[str], plant: StateSpace
) -> tuple[Any, dict[str, Any]]:
    """Split bounds into numbers and known signals; see `Design.limits`."""
    if not (signals := signals_of(bounds)):
        return bounds, {}
    for signal in signals:
        if signal not in plant.known:
            remedy = f"Pass known={[*plant.known, signal]}."
            raise QPError.expected(name, repr(signal), "numbers or known signals", remedy)
        _check_apart(name, signal, plant)
    pairs = bounds if isinstance(bounds, Mapping) else dict.fromkeys(names, tuple(bounds))
    own = {key: pair for key, pair in pairs.items() if signals_of({key: pair})}
    numbers = {key: [None if isinstance(x, str) else x for x in pair] for key, pair in own.items()}
    limits = {k: tuple(x if isinstance(x, str) else "" for x in pair) for k, pair in own.items()}
    return {**pairs, **numbers}, limits


def read_constraints(name: str, value: Any, names: Sequence[str]) -> dict[str, Constraint]:
    """Read combinations of the signals ``names`` with bounds and prices, by a name of their own."""
    want = "(weights of signals by name, (lower, upper)), or these with the price of a violation"
    if not isinstance(value, Mapping | None):
        raise QPError.expected(name, repr(value), f"a mapping from names to {want}")
    read: dict[str, Constraint] = {}
    for key, own in (value or {}).items():
        if own is None:
            continue
        given = isinstance(own, Sequence) and len(own) in (2, 3) and isinstance(own[0], Mapping)
        weights = read_vector(name, own[0] if given else {}, names, 0.0)
        price = [np.nan, *own[2:]][-1] if given else np.nan
        priced = isinstance(price, int | float | np.number) and not price < 0
        if not (np.isfinite(weights).all() and weights.any() and priced):
            raise QPError.expected(name, f"{key!r}: {own!r}", want, "Prices are >= 0, or inf.")
        (lower,), (upper,) = read_bounds(name, {key: own[1]}, [key])
        pairs = zip(names, weights.tolist(), strict=True)
        read[key] = {x: c for x, c in pairs if c}, (float(lower), float(upper)), float(price)
    return read


def read_weight(name: str, value: Any, names: Sequence[str]) -> Array:
    """Read a weight by name, as a number, a vector or a matrix, as a matrix."""
    if value is None:
        return np.zeros((len(names), len(names)))
    if not isinstance(value, Mapping) and (matrix := as_tensor(name, value)).ndim == 2:
        if matrix.shape != (len(names), len(names)):
            got = f"shape {tuple(matrix.shape)}"
            raise QPError.expected(name, got, f"({len(names)}, {len(names)})")
        weight = matrix.detach().numpy().copy()
    else:
        weight = np.diag(read_vector(name, value, names, 0.0))
    check_weight(name, torch.from_numpy(weight), diagonal=False, n_d=0)
    return weight


def read_said(name: str, value: Any, names: Sequence[str]) -> dict[str, float]:
    """Read numbers by name, but for those that None or no entry of a mapping leaves out."""
    value = {} if value is None else value
    numbers = dict(zip(names, read_vector(name, value, names, 0.0).tolist(), strict=True))
    said = value if isinstance(value, Mapping) else numbers
    return {key: numbers[key] for key, x in said.items() if x is not None}


def read_bounds(name: str, value: Any, names: Sequence[str]) -> tuple[Array, Array]:
    """Read bounds by name, or as one pair of numbers or vectors; those of moves contain zero."""
    value = {} if value is None else value
    if isinstance(value, Mapping):
        if unknown := sorted({*value} - {*names}):
            raise QPError.expected(name, repr(unknown[0]), f"names among {', '.join(names)}")
        pairs = [(None, None) if value.get(x) is None else value[x] for x in names]
        if not all(isinstance(x, Collection) and len(x) == 2 for x in pairs):
            raise QPError.expected(name, repr(dict(value)), "pairs (lower, upper) by name")
        value = [*zip(*pairs, strict=True)]
    if not isinstance(value, Collection) or len(value) != 2:
        raise QPError.expected(name, repr(value), "the pair (lower, upper), or pairs by name")
    sides = []
    for i, (side, end) in enumerate(zip(value, (-np.inf, np.inf), strict=True)):
        many = isinstance(side, list | tuple)
        side = [end if x is None else x for x in (side if many else [side])]
        sides.append(read_vector(f"{name}, side {i}", side if many else side[0], names, 0.0))
    lower, upper = sides
    some = (lower < np.inf) & (upper > -np.inf)
    ordered, want = some & (lower <= upper), "lower <= upper in each pair, or None for no bound"
    if name == "du_bounds":
        ordered, want = (lower <= 0) & (upper >= 0), "zero between the bounds"
    for i in np.flatnonzero(~ordered).tolist():
        raise QPError.expected(name, f"({lower[i]:g}, {upper[i]:g}) for {names[i]}", want)
    return lower, upper
