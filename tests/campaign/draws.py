"""Random numbers of the campaign, and batches of QPs with their true outcomes."""

import random
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tests.problems import HARD_ROWS, SOFT_ROWS, KnownQP, known_qp, times
from torch_qpmpc import QuadraticProgram, Status

#: Tolerance of a value, relative to the terms of the Lagrangian (see `tests.campaign.outcomes`).
ACCURACY, FLOAT32 = 1e-5, 1e-3


@dataclass(frozen=True)
class Case:
    """QPs with their true status ``(B,)``; ``known`` has the solutions of solvable ones."""

    known: KnownQP
    expected: Tensor
    accuracy: float = ACCURACY


class Draw(random.Random):
    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.generator = torch.Generator().manual_seed(seed)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def powers(self, low: float, high: float, *shape: int) -> Tensor:
        """Draw powers of ten with uniform exponents between ``low`` and ``high``."""
        exponent = torch.rand(shape, generator=self.generator, dtype=torch.float64)
        return 10 ** (low + (high - low) * exponent)

    def known(self, count: int, **options: Any) -> KnownQP:
        """Draw a batch of QPs of any size, with shared or separate matrices and few hard rows.

        One in four has large numbers for absent bounds, one in four rows in lengths of their own.
        """
        n_z = self.randint(3, 14)
        n_f = self.randint(0, min(4, n_z - 2))
        n_c = self.randint(0, (n_z - n_f) // 2)
        settings: dict[str, Any] = {
            "batch": (count,),
            "matrices": self.choice([(), (), (), (count,)]),
            "n_z": n_z,
            "n_f": n_f,
            "n_c": n_c,
            "soft": self.rows(SOFT_ROWS, 0, 8),
            "hard": self.rows(HARD_ROWS, 0, (n_z - n_f - n_c) // 2),
            "weight": 10 ** self.uniform(-1, 2),
        }
        known = known_qp(self.getrandbits(32), **(settings | options))
        known = self.far(known) if self.random() < 0.25 else known
        return self.in_lengths(known) if self.random() < 0.25 else known

    def far(self, known: KnownQP) -> KnownQP:
        """Move bounds that are absent or not active to between 1e3 and 1e20 from zero."""
        qp = known.qp
        y, share = times(qp.G, known.z), self.choice([0.5, 1.0])
        size = torch.maximum(y.abs(), torch.ones_like(y))
        for name, sign in (("lb", -1.0), ("ub", 1.0)):
            bound = getattr(qp, name)
            free = (sign * (bound - y) > 0.05) & (sign * known.lam <= 0)
            drawn = torch.rand(y.shape, generator=self.generator) < share
            far = sign * size * self.powers(3, 20, *y.shape)
            known = changed(known, **{name: torch.where(free & drawn, far.to(bound), bound)})
        return known

    def in_lengths(self, known: KnownQP) -> KnownQP:
        """Multiply each row of G by a factor of its own, between 1e-6 and 1e6."""
        qp = known.qp
        factor = self.powers(-6, 6, qp.G.shape[-2]).to(qp.G)
        rows = {"lb": factor * qp.lb, "ub": factor * qp.ub, "w": qp.w / factor}
        known = changed(known, G=factor[:, None] * qp.G, **rows)
        return replace(known, sigma=factor * known.sigma, lam=known.lam / factor)

    def rows(self, kinds: tuple[str, ...], least: int, most: int) -> tuple[str, ...]:
        return tuple(self.choices(kinds, k=self.randint(least, most)))

    def combinations(self, rows: Tensor, count: int) -> Tensor:
        """Draw ``count`` rows, each a multiple of one of ``rows`` or a sum of them."""
        mix = self.normal(count, len(rows))
        single = torch.rand(count, generator=self.generator) < 0.5
        one = torch.eye(len(rows)).double()[torch.arange(count) % len(rows)]
        factor = torch.tensor([self.choice([1.0, -1.0, 0.5, 3.0]) for _ in range(count)]).double()
        return torch.where(single[:, None], factor[:, None] * one, mix) @ rows


def solvable(known: KnownQP, accuracy: float = ACCURACY) -> Case:
    return Case(known, torch.full(known.value.shape, int(Status.SOLVED)), accuracy)


def changed(known: KnownQP, **tensors: Tensor) -> KnownQP:
    parts: dict[str, Any] = vars(known.qp) | tensors
    return replace(known, qp=QuadraticProgram(**parts, check_values=False))
