"""The plant that a log of outputs, inputs and known signals lets one simulate: an ARX model.

    y_{k+1} = A [y_k; ..; y_{k+1-L}] + B [u_k; ..; u_{k+1-L}] + E d_k + offset + e_k

Errors e_k and known signals d_k are those of the log.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.envs.linear_system import Rng, uniform
from torch_qpmpc.envs.past_window import first_window, next_window
from torch_qpmpc.envs.quadratic_plant import QuadraticPlant


@dataclass(frozen=True, eq=False, kw_only=True)
class ARXPlant(QuadraticPlant):
    """The physics in float64, with a quadratic cost. Its state is the window.

        L(y, u, d) = 1/2 v' W v + q'v + c + price violation(y),    v = [d; y; u]

    Known signals follow each other as in the log, from a random row on and in a circle; errors are
    drawn with replacement; starts are outputs of the log, held with inputs of zero.

    Args:
        A, B, E, offset: the model, ``(n_y, L n_y)``, ``(n_y, L n_u)``, ``(n_y, n_d)`` and
            ``(n_y,)``, with the newest lag first.
        errors: one-step errors ``(m, n_y)``.
        outputs, signals_seen: the log's rows of y ``(T, n_y)`` and d ``(T, n_d)``.
        W, q, c: the cost, ``(n, n)``, ``(n,)`` and ``()`` with n = n_d + n_y + n_u.
        lb_y, ub_y: soft bounds of the output, ``(n_y,)``.
        price: the price of a unit of violation.
        labels: names of the entries of y, u and d, for figures.
    """

    A: Tensor
    B: Tensor
    E: Tensor
    offset: Tensor
    errors: Tensor
    outputs: Tensor
    signals_seen: Tensor

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw w = [d, e], ``(count, length, n_d + n_y)``."""
        first = _rows(rng, len(self.signals_seen), count, 1)
        rows = first + torch.arange(length, device=first.device)
        errors = self.errors[_rows(rng, len(self.errors), count, length)]
        return torch.cat((self.signals_seen[rows % len(self.signals_seen)], errors), -1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        y = self.outputs[_rows(rng, len(self.outputs), count)]
        return first_window(y, self.past, 0 * self.lb_a)

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x[..., -self.n_y :]

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        v = torch.cat((w[..., : self.n_d], self.output(x, w), u), -1)
        return self._cost_of(v, self.violation(x, w))

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        d, e = w.split((self.n_d, self.n_y), -1)
        pairs = torch.cat((x, u.to(x)), -1).unflatten(-1, (self.past, -1)).flip(-2)
        y, u_lags = (part.flatten(-2) for part in pairs.split((self.n_y, self.n_u), -1))
        following = y @ self.A.mT + u_lags @ self.B.mT + d @ self.E.mT + self.offset + e
        return next_window(x, u, following)

    def violation(self, x: Tensor, w: Tensor) -> Tensor:
        return self._violation_of(self.output(x, w))


def _rows(rng: Rng, rows: int, *shape: int) -> Tensor:
    """Draw indices of rows of shape ``shape``."""
    return (uniform(rng, *shape) * rows).long()
