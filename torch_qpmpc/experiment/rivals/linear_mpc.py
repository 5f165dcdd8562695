"""Tracking MPC from the state, by a Kalman filter or omniscient of each episode's signals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import scipy
import torch
from torch import Tensor

from torch_qpmpc.envs.four_tanks import FourTanks
from torch_qpmpc.envs.tank_references import TankReferences
from torch_qpmpc.qp.program import QuadraticProgram
from torch_qpmpc.qp.solve import solve_qp


@dataclass(frozen=True)
class Tracking:
    """A cost sum_k (x_k - r_k)'Q(x_k - r_k) + (u_k - u_r)'R(u_k - u_r), and bounds.

    Attributes:
        Q, R: diagonals of the weights, ``(n_x,)`` and ``(n_u,)``.
        u_r: reference of the inputs, ``(n_u,)``.
        lb_u, ub_u: hard bounds of the inputs, ``(n_u,)``.
        lb_x, ub_x: soft bounds of x_1, .., x_N, ``(n_x,)``; infinite for none.
        price: price of a unit of violation.
        terminal_factor: factor of Q for x_N.
    """

    Q: Tensor
    R: Tensor
    u_r: Tensor
    lb_u: Tensor
    ub_u: Tensor
    lb_x: Tensor
    ub_x: Tensor
    price: float = 0.0
    terminal_factor: float = 1.0

    @classmethod
    def of(cls, plant: FourTanks | TankReferences, terminal_factor: float = 1.0) -> Tracking:
        """Make the plant's own cost and bounds."""
        Q, R = plant.weights()
        bounds = plant.lb_a, plant.ub_a
        if isinstance(plant, TankReferences):
            return cls(
                Q,
                R,
                torch.zeros_like(R),
                *bounds,
                plant.lb_x,
                plant.ub_x,
                plant.price,
                terminal_factor,
            )
        _, u_r = plant.set_point()
        free = torch.full((4,), torch.inf).to(Q)
        return cls(
            torch.nn.functional.pad(Q, (0, 2)), R, u_r, *bounds, -free, free, 0.0, terminal_factor
        )

    def program(
        self, A: Tensor, B: Tensor, horizon: int, x_r: Tensor, e: Tensor
    ) -> QuadraticProgram:
        """Return the QP in z = [x_0, u_0, x_1, .., x_N]; x_0 is to be fixed.

        Args:
            A, B: the model, ``(*batch, n_x, n_x)`` and ``(*batch, n_x, n_u)``.
            horizon: N.
            x_r: references of x_0, .., x_N, ``(*batch, N + 1, n_x)``.
            e: offsets of the N predictions, ``(*batch, N, n_x)``.
        """
        n_x, n_u = B.shape[-2:]
        n_z = horizon * (n_x + n_u) + n_x
        u_r = self.u_r.expand(*x_r.shape[:-2], horizon + 1, n_u)
        r = torch.cat((x_r, u_r), -1).flatten(-2)[..., :n_z]
        stage = torch.cat((self.Q, self.R))
        weight = torch.cat((stage.repeat(horizon), self.terminal_factor * self.Q))
        C = A.new_zeros(*A.shape[:-2], horizon * n_x, n_z)
        for k in range(horizon):
            rows, column = slice(k * n_x, (k + 1) * n_x), k * (n_x + n_u)
            C[..., rows, column : column + n_x] = -A
            C[..., rows, column + n_x : column + n_x + n_u] = -B
            C[..., rows, column + n_x + n_u : column + 2 * n_x + n_u] = torch.eye(n_x).to(A)
        lower, upper, slack = (
            torch.cat(stage).repeat(horizon + 1)[:n_z]
            for stage in (
                (self.lb_x, self.lb_u),
                (self.ub_x, self.ub_u),
                (self.Q.new_full((n_x,), self.price), self.R.new_full((n_u,), torch.inf)),
            )
        )
        lower[:n_x], upper[:n_x] = -torch.inf, torch.inf
        return QuadraticProgram(
            H=2 * torch.diag(weight),
            q=-2 * weight * r,
            c=(weight * r.square()).sum(-1),
            C=C,
            b=e.flatten(-2),
            G=torch.eye(n_z).to(A),
            lb=lower,
            ub=upper,
            w=slack,
            check_values=False,
        )


class KalmanMPC:
    """A policy of outputs: MPC of the state that a stationary Kalman filter estimates.

        y = C x + e,    x+ = A x + B u + v,    v of covariance V, e of covariance E

    Args:
        mpc: maps states ``(starts, n_x)`` to actions ``(starts, n_u)``.
        A, B, C: the model.
        V, E: covariances ``(n_x, n_x)`` and ``(n_y, n_y)``.
        x_0: mean of the start state, ``(n_x,)``.
    """

    def __init__(
        self,
        mpc: Callable[[Tensor], Tensor],
        A: Tensor,
        B: Tensor,
        C: Tensor,
        V: Tensor,
        E: Tensor,
        x_0: Tensor,
    ) -> None:
        P = scipy.linalg.solve_discrete_are(*(m.numpy() for m in (A.mT, C.mT, V, E)))
        P = torch.as_tensor(P)
        self._gain = torch.linalg.solve(C @ P @ C.mT + E, C @ P).mT
        self._mpc, self._model, self._x_0 = mpc, (A, B, C), x_0
        self._predicted: Tensor | None = None

    def begin(self, plant: object, x: Tensor, w: Tensor) -> None:
        """Forget the last episodes."""
        self._predicted = None

    def __call__(self, p: Tensor) -> Tensor:
        """Return actions; the last n_y entries of p ``(starts, n_p)`` are the new outputs."""
        A, B, C = self._model
        y = p[:, -len(C) :]
        predicted = self._x_0 if self._predicted is None else self._predicted
        x = predicted + (y - predicted @ C.mT) @ self._gain.mT
        u = self._mpc(x)
        self._predicted = x @ A.mT + u @ B.mT
        return u


class OmniscientMPC:
    """MPC that sees the state, and the model, the noise and the references of each episode.

    Args:
        plant: the plant.
        horizon: N; it is shorter where the signals end.
        terminal_factor: factor of Q for x_N.
    """

    def __init__(
        self,
        plant: FourTanks | TankReferences,
        horizon: int,
        terminal_factor: float = 1.0,
    ) -> None:
        self._plant, self._horizon = plant, horizon
        self._cost = Tracking.of(plant, terminal_factor)

    def begin(self, plant: object, x: Tensor, w: Tensor) -> None:
        """Start episodes at x with signals w."""
        self._x, self._w, self._k = x, w, 0

    def __call__(self, p: Tensor) -> Tensor:
        """Return actions ``(starts, n_u)``, ignoring p."""
        w = self._w[:, self._k : self._k + self._horizon + 1]
        _, _, e = self._plant.model(w[:, :-1])
        A, B, _ = self._plant.model(w[:, 0])
        qp = self._cost.program(A, B, e.shape[1], self._plant.target(w), e)
        n_x = self._x.shape[-1]
        solution = solve_qp(qp, self._x, solver="daqp")
        u = self._plant.applied(solution.z[:, n_x : n_x + self._plant.n_u])
        self._x = self._plant.step(self._x, u, w[:, 0])
        self._k += 1
        return u
