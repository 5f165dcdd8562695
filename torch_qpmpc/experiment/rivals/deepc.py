"""DeePC: predictive control by combinations of logged windows, with a regularisation.

    min over g    |Y g - y_r|^2_Q + |U g - u_r|^2_R + lambda_y |P_y g - y_p|^2 + lambda_g |Pi g|^2
    subject to    P_u g = u_p,    lb <= U g <= ub

The columns of P, U and Y are the past windows, the actions and the outputs of all windows of a log,
and p = (y_p, u_p) is the last window. Pi projects on what the windows and actions do not explain
(Dörfler, Coulson and Markovsky, "Bridging direct and indirect data-driven control formulations via
regularizations and relaxations", IEEE TAC 2023).
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torch_qpmpc.envs.plant import Plant
from torch_qpmpc.qp.program import QuadraticProgram
from torch_qpmpc.qp.solve import solve_qp


class DeePC:
    """A policy of windows p = [y_{1-L}, u_{1-L}, .., y_0], ``(starts, L n_y + (L - 1) n_u)``.

    With g = Q' gamma from the LQ factors of [P; U; Y], the QP has as many variables as the matrix
    has rows, whatever the length of the log.

    Args:
        log: logged outputs and actions, ``(episodes, T)``, as from `uniform_log`.
        past, horizon: L and N.
        Q, R: diagonals of the weights, ``(n_y,)`` and ``(n_u,)``.
        y_r, u_r: the set point.
        lb_u, ub_u: hard bounds of the actions, ``(n_u,)``.
        lambda_g, lambda_y: weights of the regularisation and of the past outputs' misfit.
    """

    def __init__(
        self,
        log: TensorDictBase,
        past: int,
        horizon: int,
        *,
        Q: Tensor,
        R: Tensor,
        y_r: Tensor,
        u_r: Tensor,
        lb_u: Tensor,
        ub_u: Tensor,
        lambda_g: float,
        lambda_y: float,
    ) -> None:
        n_y, n_u = len(Q), len(R)
        P, U, Y = hankel_matrices(log, past, horizon, n_y)
        n_p, n_known = len(P), len(P) + len(U)
        L = torch.linalg.qr(torch.cat((P, U, Y)).mT).R.mT
        n_gamma = L.shape[1]
        P, U, Y = L[:n_p], L[n_p:n_known], L[n_known:]
        is_output = torch.arange(n_p) % (n_y + n_u) < n_y
        penalty = torch.full((n_gamma,), lambda_g).to(L)
        penalty[:n_known] = 0
        # z = [p, gamma], and the cost is 1/2 z'Hz + q'z of the rows below with their weights.
        misfit = torch.cat((-torch.eye(n_p).to(L), P), -1)
        U, Y = (torch.nn.functional.pad(M, (n_p, 0)) for M in (U, Y))
        rows = torch.cat((Y, U, misfit[is_output]))
        targets = torch.cat((y_r.repeat(horizon), u_r.repeat(horizon), L.new_zeros(past * n_y)))
        weights = torch.cat(
            (Q.repeat(horizon), R.repeat(horizon), L.new_full((past * n_y,), lambda_y))
        )
        ridge = torch.cat((L.new_zeros(n_p), penalty))
        self._qp = QuadraticProgram(
            H=2 * (rows.mT @ (weights.unsqueeze(-1) * rows) + torch.diag(ridge)),
            q=-2 * rows.mT @ (weights * targets),
            c=weights @ targets.square(),
            C=misfit[~is_output],
            b=L.new_zeros(int((~is_output).sum())),
            G=U,
            lb=lb_u.repeat(horizon),
            ub=ub_u.repeat(horizon),
            w=torch.full((len(U),), torch.inf).to(L),
            check_values=False,
        )
        self._first = U[:n_u]

    def __call__(self, p: Tensor) -> Tensor:
        """Return actions ``(starts, n_u)``."""
        return solve_qp(self._qp, p, solver="daqp").z @ self._first.mT


def uniform_log(plant: Plant, steps: int, seed: int, episodes: int = 1) -> TensorDictBase:
    """Return ``episodes`` episodes of ``steps`` steps, ``(episodes, steps)``.

    The actions are uniform within their bounds; ``seed`` seeds them, the signals and the starts.
    """
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        env = plant.vectorised(episodes, steps, seed, episodes=episodes)
        return env.rollout(steps)


def hankel_matrices(
    log: TensorDictBase, past: int, horizon: int, n_y: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return P, U and Y, whose columns are the windows of past + horizon outputs of a log."""
    actions, last = log["action"].double(), log["next", "observation"][:, -1:]
    outputs = torch.cat((log["observation"], last), 1)[..., -n_y:].double()
    steps = past + horizon - 1
    y = outputs.unfold(1, steps + 1, 1).mT.flatten(0, 1)  # (windows, steps + 1, n_y)
    u = actions.unfold(1, steps, 1).mT.flatten(0, 1)
    stages = torch.cat((y[:, : past - 1], u[:, : past - 1]), -1).flatten(1)
    P = torch.cat((stages, y[:, past - 1]), -1)
    return P.mT, u[:, past - 1 :].flatten(1).mT, y[:, past:].flatten(1).mT
