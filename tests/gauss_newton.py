"""A reference of the Gauss-Newton step: dense in theta, with autograd's gradients."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from torch_qpmpc import QPMPC, GaussNewton
from torch_qpmpc.mpc import parameters

COST = ("H", "H_f", "q", "c", "w")


class Reference:
    """The step of a `GaussNewton` without a trust region, after those of this reference before.

    The QPMPC has two states and one action.
    """

    def __init__(self, mpc: QPMPC, optimizer: GaussNewton) -> None:
        groups = optimizer.param_groups
        self.mpc = mpc
        self.leaves: list[Tensor] = [leaf for group in groups for leaf in group["params"]]
        self.parts = [group["name"] for group in groups for _ in group["params"]]
        self.scales = [group["scale"] for group in groups for _ in group["params"]]
        self.damping = groups[0]["damping"]
        self.m = torch.zeros(3, dtype=torch.float64)
        self.sizes = dict.fromkeys(self.parts, 0.0)

    def theta(self) -> Tensor:
        return parameters_to_vector(self.leaves).detach()

    def gradients(self, s: Tensor, a: Tensor) -> list[Tensor]:
        """Compute dQ_i/dleaf as rows ``(B, n)``, one pair at a time."""
        rows = []
        for i in range(len(s)):
            value = self.mpc.action_value(s[i], a[i])
            found = torch.autograd.grad(
                value, self.leaves, allow_unused=True, materialize_grads=True
            )
            rows.append([part.flatten() for part in found])
        return [torch.stack(part) for part in zip(*rows, strict=True)]

    def units(self, z: Tensor) -> list[Tensor]:
        """Compute U of each leaf, flattened."""
        states, actions = self.mpc._layout.predicted(z)
        squares = [x.square().mean((0, 1)) for x in (states, actions)]
        self.m = self.m.maximum(torch.cat(squares))
        x, u = self.m[:2], self.m[2:]
        row = x.repeat(self.mpc.horizon)
        column = torch.cat([*[x, u] * self.mpc.horizon, x])
        found = [torch.ones_like(leaf).flatten() for leaf in self.leaves]
        if self.mpc.structure == "free":
            for k, part in enumerate(self.parts):
                if part == "b":
                    found[k] = row
                elif part == "C":
                    found[k] = (row.unsqueeze(-1) / column).flatten()
        return found

    def metric(self, gradients: list[Tensor], z: Tensor) -> Tensor:
        """Compute the diagonal of D from the gradients of a new batch."""
        units = self.units(z)
        sizes = dict.fromkeys(self.parts, 0.0)
        for part, rows, unit in zip(self.parts, gradients, units, strict=True):
            sizes[part] += (unit * rows.square()).sum(-1).mean().item()
        self.sizes = {part: max(size, self.sizes[part]) for part, size in sizes.items()}
        model = sum(size for part, size in self.sizes.items() if part not in COST)
        found = []
        for part, scale, unit in zip(self.parts, self.scales, units, strict=True):
            size = self.sizes[part] if part in COST else model
            found.append(unit * scale / (size or 1.0))
        return torch.cat(found)

    def step(
        self, s: Tensor, a: Tensor, target: Tensor, S: Tensor | None = None, past: int = 0
    ) -> Tensor:
        """Compute the step of theta; rows of ``past`` pairs before these have no error."""
        gradients, solution = self.gradients(s, a), self.mpc.solve(s, a)
        metric = self.metric(gradients, solution.z.detach())
        rows = torch.cat(gradients, dim=1)
        delta = (target - solution.value).detach()
        if past:
            earlier = getattr(self, "earlier", rows[:0])
            rows = torch.cat((rows, earlier))
            delta = torch.cat((delta, delta.new_zeros(len(earlier))))
            self.earlier = rows[:past]
        mu = self.damping * (metric * rows.square()).sum(-1).mean()
        matrix, right = rows.mT @ rows, rows.mT @ delta
        matrix += torch.diag(mu / metric)
        C, mask = parameters.matrix(self.mpc, "C")
        learned, at = [], 0
        for leaf in self.leaves:
            part = slice(at, at := at + leaf.numel())
            own = mask if leaf is C and mask is not None else torch.ones(leaf.numel()).bool()
            learned.append(own.flatten())
            if leaf is C and S is not None:
                curvature = torch.block_diag(*[len(s) * S] * len(leaf))
                matrix[part, part] += curvature
                right[part] -= curvature @ leaf.detach().flatten()
        index = torch.cat(learned).nonzero()[:, 0]
        step = torch.zeros_like(right)
        step[index] = torch.linalg.solve(matrix[index][:, index], right[index])
        return step
