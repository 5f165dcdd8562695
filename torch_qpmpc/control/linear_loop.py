"""The closed loop of a controller and its model while no bound is active: a linear system.

Its state is [x; e; u_last], the plant's state, the controller's prediction of the state and
disturbances, and the last input. Its inputs are constant loads of the plant's inputs, biases of the
outputs, and set-points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from torch_qpmpc.control.design import Target
from torch_qpmpc.control.linear_mpc import LinearMPC
from torch_qpmpc.control.observer import Observer
from torch_qpmpc.control.state_space import Array
from torch_qpmpc.export.tables import make_tables

#: Frequencies, from SLOWEST to alternating samples; doublings of the time until noise settles.
FREQUENCIES, SLOWEST, DOUBLINGS = 400, 1e-4, 50


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """The loop's matrices.

    A and B are the factors of the state and of [load; bias; r]; ``controller`` has A_c, B_c, C_c
    and D_c from y to u with the state [e; u_last], ``plant`` A, B and C of the model, and ``units``
    the sizes of the inputs.
    """

    A: Array
    B: Array
    controller: tuple[Array, Array, Array, Array]
    plant: tuple[Array, Array, Array]
    units: Array

    @classmethod
    def of(cls, mpc: LinearMPC, observer: Observer, held: bool = False) -> LinearLoop:
        """Return the loop of an observer and an MPC, or of inputs that are ``held``."""
        plant, F, G, L = mpc.design.plant, observer.F, observer.G, observer.L
        m, corrected = plant.B.shape[1], np.eye(len(F)) - L @ observer.H
        zeros = (np.zeros((m, n)) for n in (len(F), m, len(plant.C)))
        K_e, K_u, K_r = zeros if held else _gains(mpc)
        # u = C_c [e; u_last] + D_c y + K_r r, and e+ = F (corrected e + L y) + G u.
        C_c, D_c = np.hstack((K_e @ corrected, K_u)), K_e @ L
        A_c = np.vstack((np.hstack((F @ corrected, np.zeros((len(F), m)))) + G @ C_c, C_c))
        B_c = np.vstack((F @ L + G @ D_c, D_c))
        A = np.block([[plant.A + plant.B @ D_c @ plant.C, plant.B @ C_c], [B_c @ plant.C, A_c]])
        own = np.zeros((len(A_c), m)), B_c, np.vstack((G @ K_r, K_r))
        B = np.block([[plant.B, plant.B @ D_c, plant.B @ K_r], [*own]])
        return cls(A, B, (A_c, B_c, C_c, D_c), (plant.A, plant.B, plant.C), mpc.design.scaling.u)

    @property
    def radius(self) -> float:
        """The largest modulus of the eigenvalues."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    def offsets(self) -> Array:
        """Return y - r at rest for a unit of each load, bias and set-point, as columns."""
        n_y, n = self.plant[2].shape
        x = np.linalg.solve(np.eye(len(self.A)) - self.A, self.B)[:n]
        m = self.B.shape[1] - 2 * n_y
        return self.plant[2] @ x + np.hstack((np.zeros((n_y, m)), np.eye(n_y), -np.eye(n_y)))

    def under(self, noise: tuple[Array, Array], Q: Array) -> tuple[float, Array]:
        """Return the mean y'Q y and inputs' deviations by a model's noise, inf if none settle."""
        (_, _, C_c, D_c), (A, _, C), (L, S) = self.controller, self.plant, noise
        (n_y, n), m = C.shape, len(D_c)
        if not self.radius < 1:
            return np.inf, np.full(m, np.inf)
        N = self.B[:, m : m + n_y] + np.eye(len(self.A), n) @ A @ L
        A, X = self.A, N @ S @ N.T
        for _ in range(DOUBLINGS):
            X, A = X + A @ X @ A.T, A @ A
        parts = (C @ np.eye(n, len(A)), np.eye(n_y)), (np.hstack((D_c @ C, C_c)), D_c)
        y, u = (M @ X @ M.T + D @ S @ D.T for M, D in parts)
        return float(np.sum(Q * y)), np.sqrt(np.diag(u))

    def modulus_margin(self) -> float:
        """Return the least distance of the loop's return difference at the inputs from singular.

        Each input alone tolerates gains in 1 / (1 + a), .., 1 / (1 - a) and phases of 2 asin(a / 2)
        for the margin a (Skogestad and Postlethwaite, "Multivariable feedback control", 2005).
        """
        A_c, B_c, C_c, D_c = self.controller
        z = np.exp(1j * np.geomspace(SLOWEST, np.pi, FREQUENCIES))[:, None, None]
        P, K = (
            C @ np.linalg.solve(z * np.eye(len(A)) - A, B[None])  # NumPy 1 takes B for vectors
            for A, B, C in (self.plant, (A_c, B_c, C_c))
        )
        loop = (K + D_c) @ P * (self.units / self.units[:, None])
        return float(np.linalg.svd(np.eye(len(D_c)) - loop, compute_uv=False)[:, -1].min())


def _gains(mpc: LinearMPC) -> tuple[Array, Array, Array]:
    """Return the gains of the unconstrained law on the estimate e, u_last and r."""
    design, plan, target = mpc.design, make_tables(mpc.plan), make_tables(mpc.targets)
    n, m, n_y, n_d = design.plant.sizes
    n_w = len(design.disturbances.names)
    signals = torch.eye(1 + n + n_w + m + n_y, dtype=torch.float64)[:, 1:]
    x, w, u_last, r = signals.split((n, n_w, m, n_y), dim=-1)
    s = torch.cat((r, w, r.new_zeros(len(r), n_d), r.new_ones(len(r), 1)), -1)
    state = torch.cat((s.new_zeros(len(s), design.steady.anchors), s), -1)
    v = state @ torch.from_numpy(target.K.T) + torch.from_numpy(target.k)
    lam = s.new_zeros(len(s), len(mpc.targets.quadratic_program().lb))
    aimed = design.steady_state(torch, v, s, lam)
    stages = aimed
    if design.staged:
        stages = Target(*(part[:, None].expand(-1, mpc.horizon + 1, -1) for part in aimed))
    p = mpc.arrange(x, stages, u_last=u_last)
    u = aimed.u.numpy() + p.numpy() @ plan.K.T + plan.k
    K_e, K_u, K_r = np.split((u[1:] - u[0]).T, np.cumsum((n + n_w, m)), axis=1)
    return K_e, K_u, K_r
