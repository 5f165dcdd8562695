"""A reference of the Gauss-Newton step: dense in theta, with autograd's gradients."""

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from torch_qpmpc import QPMPC, GaussNewton

COST = ("H", "H_f", "q", "c", "w")


def penalty(mpc: QPMPC, S: Tensor) -> float:
    """Return the penalty ``1/2 tr(D S D')`` of D = [C, b]."""
    D = torch.cat((mpc.C, mpc.b.unsqueeze(-1)), -1)
    return 0.5 * ((D @ S) * D).sum().item()


class Reference:
    def __init__(self, mpc: QPMPC, optimizer: GaussNewton) -> None:
        groups = optimizer.param_groups
        self.mpc = mpc
        self.leaves: list[Tensor] = [leaf for group in groups for leaf in group["params"]]
        self.parts = [group["name"] for group in groups for _ in group["params"]]
        self.scales = [group["scale"] for group in groups for _ in group["params"]]
        self.damping = groups[0]["damping"]
        self.m = torch.zeros(mpc.n_x + mpc.n_u + mpc.n_d, dtype=torch.float64)
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
        mpc, n = self.mpc, self.mpc.n_x + self.mpc.n_u
        preview = (mpc.horizon + 1) * mpc.n_d
        d, stages = z[:, :preview], z[:, preview:]
        stages = torch.cat((stages, stages.new_full((len(z), mpc.n_u), torch.nan)), dim=-1)
        values = [stages.reshape(-1, n), d.reshape(len(z) * (mpc.horizon + 1), mpc.n_d)]
        self.m = (0.9 * self.m).maximum(torch.cat([x.square().nanmean(0) for x in values]))
        stage, d = self.m.split((n, mpc.n_d))
        row = stage[: mpc.n_x].repeat(mpc.horizon)
        column = torch.cat((d.repeat(mpc.horizon + 1), stage.repeat(mpc.horizon + 1)))
        column = column[: mpc.n_z]
        found = [torch.ones_like(leaf).flatten() for leaf in self.leaves]
        if self.mpc.structure == "free":
            for k, part in enumerate(self.parts):
                if part == "b":
                    found[k] = row
                elif part == "q":
                    found[k] = 1 / column
                elif part == "C":
                    found[k] = (row.unsqueeze(-1) / column).flatten()
        return found

    def metric(self, gradients: list[Tensor], z: Tensor) -> Tensor:
        units = self.units(z)
        sizes = dict.fromkeys(self.parts, 0.0)
        for part, rows, unit in zip(self.parts, gradients, units, strict=True):
            sizes[part] += (unit * rows.square()).sum(-1).mean().item()
        self.sizes = {part: max(size, 0.9 * self.sizes[part]) for part, size in sizes.items()}
        model = sum(size for part, size in self.sizes.items() if part not in COST)
        found = []
        for part, scale, unit in zip(self.parts, self.scales, units, strict=True):
            size = self.sizes[part] if part in COST else model
            found.append(unit * scale / (size or 1.0))
        return torch.cat(found)

    def step(
        self,
        s: Tensor,
        a: Tensor,
        target: Tensor,
        S: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Tensor:
        solution, root = self.mpc.solve(s, a), torch.ones(len(s)).double()
        if weight is not None:
            root = weight.sqrt()
        gradients = [root.unsqueeze(-1) * part for part in self.gradients(s, a)]
        metric = self.metric(gradients, solution.z.detach())
        rows = torch.cat(gradients, dim=1)
        delta = root * (target - solution.value).detach()
        mu = self.damping * (metric * rows.square()).sum(-1).mean()
        matrix, right = rows.mT @ rows, rows.mT @ delta
        matrix += torch.diag(mu / metric)
        at = 0
        for leaf in self.leaves:
            part = slice(at, at := at + leaf.numel())
            if leaf is self.mpc.C and S is not None:
                D = torch.cat((leaf, self.mpc.b.unsqueeze(-1)), -1).detach()
                matrix[part, part] += torch.block_diag(*[len(s) * S[:-1, :-1]] * len(leaf))
                right[part] -= len(s) * (D @ S)[:, :-1].flatten()
        return torch.linalg.solve(matrix, right)
