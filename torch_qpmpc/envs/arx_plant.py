"""The plant that a log of outputs, inputs and known signals lets one simulate: an ARX model.

    y_{k+1} = A [y_k; ..; y_{k+1-L}] + B [u_k; ..; u_{k+1-L}] + E d_k + offset + e_k

Errors e_k and known signals d_k are those of the log. `ARXMember`, one model of an ensemble, has
any cost of outputs, inputs and known signals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_qpmpc.envs.linear_system import Rng, uniform
from torch_qpmpc.envs.past_window import first_window, next_window
from torch_qpmpc.envs.plant import Plant


@dataclass(frozen=True, eq=False, kw_only=True)
class ARXModel(Plant):
    """The physics in float64 without a cost. The state is the window.

    Known signals follow each other as in the log, from a random one of the rows ``first`` on and in
    a circle; errors are drawn with replacement; starts are outputs of the log in rows ``first``,
    held with inputs of zero.

    Args:
        A, B, E, offset: the model, ``(n_y, L n_y)``, ``(n_y, L n_u)``, ``(n_y, n_d)`` and
            ``(n_y,)``, with the newest lag first.
        errors: one-step errors ``(m, n_y)``.
        outputs, signals_seen: the log's rows of y ``(T, n_y)`` and d ``(T, n_d)``.
        first: rows in which episodes may begin; None for all.
    """

    A: Tensor
    B: Tensor
    E: Tensor
    offset: Tensor
    errors: Tensor
    outputs: Tensor
    signals_seen: Tensor
    first: Tensor | None = None

    def signals(self, rng: Rng, count: int, length: int) -> Tensor:
        """Draw w = [d, e], ``(count, length, n_d + n_y)``."""
        rows = self._first(rng, count, 1) + torch.arange(length, device=self.outputs.device)
        errors = self.errors[_rows(rng, len(self.errors), count, length)]
        return torch.cat((self.signals_seen[rows % len(self.signals_seen)], errors), -1)

    def starts(self, rng: Rng, count: int) -> Tensor:
        return first_window(
            self.outputs[self._first(rng, count)], self.past, torch.zeros_like(self.lb_a)
        )

    def _first(self, rng: Rng, *shape: int) -> Tensor:
        if self.first is None:
            return _rows(rng, len(self.outputs), *shape)
        return self.first[_rows(rng, len(self.first), *shape)]

    def output(self, x: Tensor, w: Tensor) -> Tensor:
        return x[..., -self.n_y :]

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        d, e = w.split((self.n_d, self.n_y), -1)
        pairs = torch.cat((x, u.to(x)), -1).unflatten(-1, (self.past, -1)).flip(-2)
        y, u_lags = (part.flatten(-2) for part in pairs.split((self.n_y, self.n_u), -1))
        following = y @ self.A.mT + u_lags @ self.B.mT + d @ self.E.mT + self.offset + e
        return next_window(x, u, following)


@dataclass(frozen=True, eq=False, kw_only=True)
class ARXMember(ARXModel):
    """A model with a cost ``stage_cost(y, u, d)`` ``(*batch,)`` of any form."""

    stage_cost: Callable[[Tensor, Tensor, Tensor], Tensor]

    def cost(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        return self.stage_cost(self.output(x, w), u, w[..., : self.n_d])


def _rows(rng: Rng, rows: int, *shape: int) -> Tensor:
    """Draw indices of rows of shape ``shape``."""
    return (uniform(rng, *shape) * rows).long()
