"""A gate: a learned policy acts only once closed loops show that it costs less.

A falling TD error does not make a better policy. Learning therefore moves a candidate, and a paired
comparison of closed loops, with the same starts and disturbances for both, lets it replace the
policy that acts, or not.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torch_qpmpc.checks import check_number, check_tensor, check_whole
from torch_qpmpc.errors import QPError

#: Fewest pairs of a decision: the test relies on a central limit theorem.
FEWEST = 16


class PairedTest:
    """A sequential test of paired differences: cost of the candidate minus cost of the incumbent.

    The interval of the mean difference after n pairs, with their mean and standard deviation sd,

        mean -+ sd sqrt(2 (n rho^2 + 1) / (n rho)^2 log(sqrt(n rho^2 + 1) / alpha)),

    is an asymptotic confidence sequence (Waudby-Smith, Arbour, Sinha, Kennedy and Ramdas, Annals of
    Statistics 52, 2024): it covers the mean at all n at once with probability 1 - alpha, so that
    a test may look after each pair and stop as soon as it is decided. Without a simulator a pair is
    an episode of either policy, one after the other.

    Args:
        alpha: the probability of a wrong decision, in (0, 1).
        narrowest: the number of pairs at which the interval is tightest, which sets rho.

    Raises:
        QPError: an argument is out of range.

    Example:
        >>> test = PairedTest()
        >>> test.add(torch.linspace(-3.0, 1.0, 32))
        >>> test.decision, [round(end, 2) for end in test.interval]
        ('better', [-1.65, -0.35])
    """

    def __init__(self, alpha: float = 0.05, narrowest: int = 32) -> None:
        check_number("alpha", alpha, lambda x: 0 < x < 1, "a probability in (0, 1)")
        check_whole("narrowest", narrowest, 1)
        a = -2 * math.log(alpha)
        self.alpha, self._rho2 = alpha, (a + math.log(1 + a)) / narrowest
        self.pairs, self._sum, self._squares = 0, 0.0, 0.0

    def add(self, differences: Tensor) -> None:
        """Add the differences ``(n,)`` of new pairs; an infinite one decides, as does a NaN.

        Raises:
            QPError: the shape does not fit.
        """
        check_tensor("differences", differences, len(differences), batched=False)
        self.pairs += len(differences)
        self._sum += float(differences.double().sum())
        self._squares += float(differences.double().square().sum())

    @property
    def mean(self) -> float:
        """The mean difference; nan without pairs."""
        return self._sum / self.pairs if self.pairs else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """The confidence interval of the mean difference, infinite with fewer than 16 pairs."""
        n, rho2 = self.pairs, self._rho2
        if n < FEWEST or not math.isfinite(self._sum):
            return -math.inf, math.inf
        variance = max(self._squares / n - self.mean**2, 0.0) * n / (n - 1)
        factor = 2 * (n * rho2 + 1) / (n**2 * rho2)
        half = math.sqrt(variance * factor * math.log(math.sqrt(n * rho2 + 1) / self.alpha))
        return self.mean - half, self.mean + half

    @property
    def decision(self) -> str:
        """``"better"`` or ``"worse"`` if the interval says so of the candidate, else ``"open"``."""
        if not math.isfinite(self._sum):
            return "better" if self._sum == -math.inf else "worse"
        low, high = self.interval
        return "better" if high < 0 else "worse" if low > 0 else "open"


@dataclass(frozen=True)
class Verdict:
    """The outcome of a comparison: the candidate is ``accepted``, at an interval of ``mean``.

    ``restarted`` is True if the candidate has become a copy of the acting policy.
    """

    accepted: bool
    mean: float
    low: float
    high: float
    pairs: int
    restarted: bool = False


class Gate:
    """Holds the policy that acts, and replaces it by a candidate that is shown to cost less.

    Args:
        actor: the first policy; the gate acts with a copy.
        costs: maps a policy and a seed to the costs ``(starts,)`` of closed loops, with starts and
            disturbances from the seed alone.
        pairs: the number of pairs after which an undecided comparison rejects the candidate.
        alpha: the probability of a wrong decision in one comparison.
        patience: the number of rejections in a row after which the candidate becomes a copy of the
            acting policy.
        seed: seeds the starts and disturbances of all comparisons.

    Attributes:
        actor: the policy that acts.
        accepted, rejected: the numbers of decisions.

    Raises:
        QPError: an argument is out of range.

    Example:
        >>> import torch_qpmpc as qm
        >>> from torch_qpmpc.envs import PointMass
        >>> from torch_qpmpc.envs.closed_loop import closed_loop
        >>> physics = PointMass()
        >>> def costs(mpc, seed):
        ...     return closed_loop(mpc.policy, physics, steps=20, seed=seed).costs.sum(0)
        >>> options = {"stage_weight": [1.0] * 4 + [0.1] * 2, "action_bounds": ([-1] * 2, [1] * 2)}
        >>> mpc = qm.QPMPC.from_model(physics.A, physics.B, 5, **options)
        >>> gate = Gate(mpc, costs)
        >>> gate.judge(mpc).accepted  # an equal policy is no better
        False
    """

    def __init__(
        self,
        actor: nn.Module,
        costs: Callable[[nn.Module, int], Tensor],
        *,
        pairs: int = 96,
        alpha: float = 0.05,
        patience: int = 3,
        seed: int = 0,
    ) -> None:
        check_whole("pairs", pairs, FEWEST)
        check_whole("patience", patience, 1)
        check_whole("seed", seed, 0)
        PairedTest(alpha)
        self.actor, self._costs = copy.deepcopy(actor), costs
        self._pairs, self._alpha, self._patience, self._seed = pairs, alpha, patience, seed
        self.accepted = self.rejected = self._in_a_row = 0

    @torch.no_grad()
    def judge(self, candidate: nn.Module) -> Verdict:
        """Compare ``candidate`` with the acting policy on new starts and disturbances.

        Pairs are added until the test is decided, the candidate's mean cost is no lower, or there
        are ``pairs``. An accepted candidate's parameters are copied to the acting policy; after
        ``patience`` rejections in a row it is the other way round.

        Raises:
            QPError: ``costs`` returns another shape than ``(starts,)``.
        """
        test, count = PairedTest(self._alpha), 0
        # A candidate that costs as much or more so far is hardly worth more pairs.
        while test.decision == "open" and test.pairs < self._pairs and not test.mean >= 0:
            entropy = [self._seed, self.accepted + self.rejected, count]
            seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
            old, new = (self._costs(actor, seed) for actor in (self.actor, candidate))
            if old.ndim != 1 or new.shape != old.shape or not len(old):
                got = f"shapes {tuple(old.shape)} and {tuple(new.shape)}"
                raise QPError.expected("costs", got, "one cost for each start, (starts,)")
            # A policy that fails costs more than any other.
            difference = torch.where(old.isfinite(), new - old, -math.inf)
            test.add(difference.where(new.isfinite(), math.inf))
            count += 1
        accepted, restarted = test.decision == "better", False
        self._in_a_row = 0 if accepted else self._in_a_row + 1
        if accepted:
            self.accepted += 1
            self.actor.load_state_dict(candidate.state_dict())
        else:
            self.rejected += 1
            restarted = self._in_a_row >= self._patience
            if restarted:
                candidate.load_state_dict(self.actor.state_dict())
                self._in_a_row = 0
        return Verdict(accepted, test.mean, *test.interval, test.pairs, restarted)

    def state_dict(self) -> dict[str, Any]:
        """Return the acting policy's parameters and the numbers of decisions."""
        counts = [self.accepted, self.rejected, self._in_a_row]
        return {"actor": self.actor.state_dict(), "counts": counts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a `state_dict`."""
        self.actor.load_state_dict(state["actor"])
        self.accepted, self.rejected, self._in_a_row = state["counts"]
