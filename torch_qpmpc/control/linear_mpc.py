"""`LinearMPC`: a linear MPC in an engineer's terms, lowered onto `QPMPC` by a scheme."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.linalg import block_diag
from torch import Tensor

from torch_qpmpc.control.design import Design, read_design
from torch_qpmpc.control.state_space import Array, read_model
from torch_qpmpc.control.target import target_mpc
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.bounds import Bounds
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.model import Model
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.regulator import lqr_gain
from torch_qpmpc.mpc.riccati import riccati_weight
from torch_qpmpc.mpc.scheme import Scheme
from torch_qpmpc.qp.program import QuadraticProgram

#: The price of a unit of violation of an output's bound.
Y_SLACK = 1e3
#: Near the target the values are constant, SCALE times those of a typical deviation in each stage:
#: errors of a value are certified relative to it, and those of zero could not be.
SCALE = 1e-2


@dataclass(frozen=True, eq=False, repr=False)
class LinearScheme(Scheme):
    """The scheme of a linear MPC, with the design that it is made from."""

    design: Design | None = None


class Target(NamedTuple):
    """Steady states: x_s ``(*batch, n)``, u_s ``(*batch, m)`` and y_s ``(*batch, n_y)``."""

    x: Tensor
    u: Tensor
    y: Tensor


class LinearMPC(QPMPC):
    """A linear MPC with set-points, prices of moves and disturbances: a `QPMPC`.

    The plan's cost is the sum over the stages of

        (y - y_s)'Q(y - y_s) + (u - u_s)'R(u - u_s) + du'dR du + price u,    du = u_k - u_{k-1},

    without a half, about the target: the steady state (x_s, u_s, y_s) of the model that is nearest
    to the set-point r within the bounds, so that R moves no output off r. The terminal cost is the
    Riccati equation's about (x_s, u_s) if it has a stabilising solution, else that of y_N.

    All signals are deviations from the target, which keeps the values near it exact. p has d_0, ..,
    d_N, each of known signals, of which those that act on the plant are less their mean; then the
    state [x - x_s; u_last - u_s; y_s; u_s; 1].
    In it u_last is there if moves cost or are bounded, and y_s and u_s are those with bounds.
    The last entry adds a small constant to the values, which their errors are relative to. With
    ``references="preview"`` d_k begins with the set-points and inputs of later stages. `target` and
    `arrange` make p, and the policy is u - u_s; `Controller` does all of it.

    Args:
        model, E, dt, inputs, outputs, known: the plant; see `read_model`.
        horizon: N.
        Q, R, dR: weights by name, as a number, a vector or a matrix; zero by default.
        y_bounds, u_bounds, du_bounds: pairs (lower, upper) by name, or one pair; unbounded by
            default. Bounds of inputs and moves are hard.
        y_slack: the price of a unit of violation of an output's bounds; inf makes them hard.
        linear: price times input, as a mapping from inputs to numbers or names of known signals.
        references: ``"held"``: one r for the plan. ``"preview"``: one for each stage.
        disturbances: those that an observer estimates, by default one for each output; see
            `torch_qpmpc.control.disturbance.choose`.
        gamma: the discount.
        options: ``learn``, ``structure``, ``step``, ``solver`` and ``on_failure`` of `QPMPC`; by
            default a tied structure that learns nothing, and DAQP.

    Raises:
        QPError: an argument is invalid, or nothing has a cost.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> model = ([[0.9]], [[0.5]])  # x+ = 0.9 x + 0.5 u, which is measured
        >>> mpc = qm.LinearMPC(model, 10, Q=1.0, R=0.1, dR=0.1, u_bounds=(-1.0, 1.0))
        >>> target = mpc.target(r=[2.0])
        >>> p = mpc.arrange(x=[2.0], u_last=[0.4], target=target)
        >>> target.u + mpc.policy(p).detach()  # at the set-point the input that holds it
        tensor([0.4000], dtype=torch.float64)
    """

    scheme: LinearScheme
    _targets: QPMPC
    _target_qp: QuadraticProgram

    def __init__(
        self,
        model: Any,
        horizon: int | None = None,
        *,
        Q: Any = None,
        R: Any = None,
        dR: Any = None,
        y_bounds: Any = None,
        u_bounds: Any = None,
        du_bounds: Any = None,
        y_slack: Any = Y_SLACK,
        linear: Mapping[str, str | float] | None = None,
        references: str = "held",
        disturbances: Any = "auto",
        gamma: float = 1.0,
        E: Any = None,
        dt: float | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        known: Sequence[str] = (),
        **options: Any,
    ) -> None:
        if isinstance(model, LinearScheme):  # as copies and pickles pass it
            super().__init__(model, **options)
            self._start_targets()
            return
        prices = linear.values() if isinstance(linear, Mapping) else ()
        design = read_design(
            read_model(model, E, dt, inputs, outputs, known, prices),
            horizon,
            Q=Q,
            R=R,
            dR=dR,
            y_bounds=y_bounds,
            u_bounds=u_bounds,
            du_bounds=du_bounds,
            y_slack=y_slack,
            linear=linear,
            references=references,
            disturbances=disturbances,
            gamma=gamma,
        )
        defaults = {"structure": "tied", "learn": (), "solver": "daqp"}
        super().__init__(lowered(design), **{**defaults, **options})
        self._start_targets()

    def _start_targets(self) -> None:
        """Make the QP of the target, which is not learned and no submodule."""
        targets = target_mpc(self.design)
        vars(self).update(_targets=targets, _target_qp=targets.quadratic_program())

    @property
    def design(self) -> Design:
        """The `Design` of the arguments."""
        assert self.scheme.design is not None
        return self.scheme.design

    @classmethod
    def load(cls, path: str | PathLike[str]) -> QPMPC:
        """Raise `QPError`: a saved file has the QP without its design; `QPMPC.load` reads it."""
        remedy = "Make the LinearMPC again from its model, or load its QP with QPMPC.load."
        raise QPError.expected("LinearMPC.load", str(path), "a file with a design", remedy)

    @torch.no_grad()
    def target(self, r: Any, w: Any = 0.0, known: Any = 0.0) -> Target:
        """Return the steady states within the bounds that are nearest to set-points.

        Args:
            r: ``(*batch, n_y)``.
            w: the disturbances ``(*batch, n_w)``, or a number for all.
            known: the level of the known signals, ``(*batch, n_d)``, or a number for all.

        Raises:
            QPError: a shape is wrong.
            SolverError: the bounds of the inputs admit no steady state.
        """
        s = self._target_inputs(r, w, known)
        steady = self.design.steady
        v = self._targets.policy(s, qp=self._target_qp)
        loads = torch.cat((s[..., len(steady.Q) :], s.new_ones(*s.shape[:-1], 1)), -1)
        pairs = ((steady.X, steady.x), (steady.U, steady.u), (steady.Y, steady.y))
        return Target(*(v @ s.new_tensor(Z.T) + loads @ s.new_tensor(M.T) for Z, M in pairs))

    def _target_inputs(self, r: Any, w: Any, known: Any) -> Tensor:
        """Return [r; w; d] ``(*batch, n_y + n_w + n_d)``."""
        sizes = {"r": len(self.design.Q), "w": len(self.design.disturbances.names)}
        sizes["known"] = self.design.plant.sizes[3]
        parts = {"r": r, "w": w, "known": known}
        parts = {k: torch.as_tensor(x, dtype=torch.float64) for k, x in parts.items()}
        for name, part in parts.items():
            if part.ndim and part.shape[-1] != sizes[name]:
                got, want = f"shape {tuple(part.shape)}", f"(*batch, {sizes[name]})"
                raise QPError.expected(name, got, want)
        batch = torch.broadcast_shapes(*(part.shape[:-1] for part in parts.values()))
        return torch.cat([part.expand(*batch, sizes[name]) for name, part in parts.items()], -1)

    def arrange(self, x: Any, target: Target, **signals: Any) -> Tensor:
        """Return p ``(*batch, n_p)`` in float64.

        Args:
            x: the state, ``(*batch, n)``.
            target: the `target`; with a preview of references those of the stages,
                ``(*batch, N + 1, ..)``, of which the last is the one that p is relative to.
            signals: ``u_last`` ``(*batch, m)``, u_s if left out; ``known`` ``(*batch, N + 1, n_d)``
                and the ``level`` ``(*batch, n_d)`` that the target is for; zero if left out.

        Raises:
            QPError: a name or a shape is wrong.
        """
        places, n_d = self.design.places, self.n_d
        if unknown := sorted(signals.keys() - {"u_last", "known", "level"}):
            raise QPError.expected("signals", repr(unknown[0]), "some of u_last, known, level")
        values = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in signals.items()}
        if (level := values.pop("level", None)) is not None:
            loads = torch.from_numpy(self.design.plant.E.any(0))
            values["known"] = values["known"] - (level * loads).unsqueeze(-2)
        base = target
        if self.design.references == "preview":
            base = Target(*(part[..., -1, :] for part in target))
            values |= {
                "r": target.y - target.y[..., -1:, :],
                "u_r": target.u - target.u[..., -1:, :],
            }
        x = torch.as_tensor(x, dtype=torch.float64)
        values |= {"x": x - base.x, "u_last": values.get("u_last", base.u) - base.u}
        y, u = (torch.from_numpy(mask) for mask in self.design.bounded)
        values |= {"y_s": base.y[..., y], "u_s": base.u[..., u], "one": x.new_ones(())}
        d = x.new_zeros(*x.shape[:-1], self.horizon + 1, n_d)
        state = x.new_zeros(*x.shape[:-1], self.n_x)
        for name, value in values.items():
            place = places[name]
            if place.start == place.stop and name != "known":
                continue
            part = d[..., place] if place.stop <= n_d else state[..., _shifted(place, -n_d)]
            try:
                part.copy_(value)
            except RuntimeError as error:
                want = f"{part.shape[-1]} entries, and batch dimensions as those of x"
                raise QPError.expected(name, f"shape {tuple(value.shape)}", want) from error
        return torch.cat((d.flatten(-2), state), -1)


def _shifted(place: slice, by: int) -> slice:
    return slice(place.start + by, place.stop + by)


def lowered(design: Design) -> LinearScheme:
    """Return the scheme of a design, in deviations from the target."""
    places = design.places
    n_d = places["known"].stop
    layout = Layout(places["u"].start - n_d, design.plant.sizes[1], design.horizon, 1, n_d)
    parts = _model(design), _cost(design, layout), _bounds(design)
    return LinearScheme(layout, *parts, design.gamma, design=design)


def _model(design: Design) -> Model:
    """Return the model of [x; u_last; y_s; u_s; 1], where y_s and u_s stay."""
    s, plant = design.selectors(), design.plant
    n_d = design.places["known"].stop
    x = plant.A @ s["x"] + plant.B @ s["u"] + plant.E @ s["known"]
    rows = np.vstack((x, s["u"][: len(s["u_last"])], s["y_s"], s["u_s"], s["one"]))
    n_x = n_d + len(rows)
    return Model(rows[:, n_d:n_x], rows[:, n_x:], rows[:, :n_d])


def _cost(design: Design, layout: Layout) -> Cost:
    """Return the squares of deviations from the target, and the prices."""
    s, places, plant = design.selectors(), design.places, design.plant
    y, u = plant.C @ s["x"], s["u"].copy()
    y[: len(s["r"])] -= s["r"]
    u[: len(s["u_r"])] -= s["u_r"]
    du = [s["u"] - s["u_last"]] if design.moves else []
    T = np.vstack((y, u, *du))
    stage = 2 * T.T @ block_diag(design.Q, design.R, *[design.dR] * len(du)) @ T
    linear = np.zeros(len(stage))
    for name, price in design.linear.items():
        i = places["u"].start + plant.inputs.index(name)
        if isinstance(price, str):
            j = places["known"].start + plant.known.index(price)
            stage[i, j] += 1
            stage[j, i] += 1
        else:
            linear[i] += price
    one = places["one"].start
    stage[one, one] = 2 * SCALE * design.typical
    size = places["u"].start
    P = _riccati(design)
    x = np.vstack((s["x"], s["u_last"]))[:, :size]
    terminal = 2 * y[:, :size].T @ design.Q @ y[:, :size] if P is None else x.T @ P @ x
    q = layout.from_stage(torch.as_tensor(linear).expand(layout.horizon, 1, -1)).sum(0)
    return Cost(stage, terminal, hessian="block", q=q)


def _riccati(design: Design) -> Array | None:
    """Return the cost to go of [x; u_last] about a steady state, None if it does not exist."""
    plant, m = design.plant, design.plant.sizes[1]
    A, B = plant.A, plant.B
    Q, R = 2 * plant.C.T @ design.Q @ plant.C, 2 * (design.R + design.dR)
    S = np.zeros_like(B)
    if design.moves:
        A, B = block_diag(A, np.zeros((m, m))), np.vstack((B, np.eye(m)))
        Q, S = block_diag(Q, 2 * design.dR), np.vstack((S, -2 * design.dR))
    A, B, W = (torch.as_tensor(x) for x in (A, B, np.block([[Q, S], [S.T, R]])))
    try:
        P = riccati_weight(A, B, W, design.gamma)
        K = lqr_gain(A, B, W, design.gamma)
    except (QPError, RuntimeError):  # the latter of a singular matrix
        return None
    radius = torch.linalg.eigvals(A - B @ K).abs().max() * design.gamma**0.5
    eigenvalues = torch.linalg.eigvalsh(P)
    exists = radius < 1 - 1e-9 and eigenvalues[0] >= -1e-9 * eigenvalues[-1].abs()
    return P.numpy() if exists else None


def _bounds(design: Design) -> Bounds:
    """Return rows of the outputs at their prices, and hard ones of inputs and moves."""
    s, size = design.selectors(), design.places["u"].start
    moving = np.isfinite(design.du_bounds).any(0)
    of_y, of_u = design.bounded
    y = (design.plant.C @ s["x"])[of_y] + s["y_s"]
    du = s["u"][moving] - s["u_last"][moving] if moving.any() else y[:0]
    D = np.vstack((y, s["u"][of_u] + s["u_s"], du))
    sides = ((design.y_bounds, of_y), (design.u_bounds, of_u), (design.du_bounds, moving))
    lower, upper = (
        np.concatenate([bounds[side][rows] for bounds, rows in sides]) for side in (0, 1)
    )
    n_y = len(y)
    price = design.y_slack[of_y]
    return Bounds(
        constraints=(D, lower, upper) if len(D) else None,
        terminal_constraints=(y[:, :size], lower[:n_y], upper[:n_y]) if n_y else None,
        constraint_slack=np.concatenate((price, np.full(len(D) - n_y, np.inf), price)),
        discount_slack=True,
    )
