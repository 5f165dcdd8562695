"""A gate: a learned policy is kept only once paired closed loops show that it costs less."""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torch_qpmpc.checks import POSITIVE, check_number, check_seed, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.validation import without_gradients

#: Maps a policy and a seed to the costs of closed loops.
Costs = Callable[[nn.Module, int], Tensor]
#: Fewest pairs of a decision.
FEWEST = 16
#: Pairs that only set the scale of the differences without a bound.
FIRST = 8
#: Largest loss of a pair that is assumed without a bound, in mean absolute differences.
MULTIPLE = 5.0
#: Differences within this fraction of their mean size are equal.
EQUAL = 1e-9
#: Stakes, as fractions of the largest one that no loss within the bound can turn into a debt.
STAKES = np.array([0.25, 0.5, 1.0])


class PairedTest:
    """A sequential test of paired differences d: the candidate's cost minus the incumbent's.

    It bets against E d >= 0. The wealth after n pairs, averaged over the stakes c = 1/4, 1/2 and 1,

        W_n = mean_c prod_t (1 - c d_t / M_t),

    is a nonnegative supermartingale if no pair loses more than M_t, whatever the gains: it exceeds
    2 / alpha at any n with probability alpha / 2 at most (Ville), so that a test may look after
    each pair; bets against E d <= 0 have the other half. No test of a mean does without such a
    bound (Bahadur and Savage, 1956). Without ``bound`` it comes from the pairs before t,

        M_t = 5 mean |d| max(1, (max d - mean d) / (mean d - min d)),

    which grows where losses have the longer tail, and is infinite for the first 8 pairs and while
    all differences are equal. The assumption is then that no pair loses more than that. A pair that
    does is a veto: the candidate is worse. A failure rarer than about 3 / n may leave no trace in n
    pairs: a plant that cannot afford one needs ``bound``.

    Args:
        alpha: the probability of a wrong decision, in (0, 1).
        bound: the largest loss of one pair, such as the cost of a failed episode.

    Attributes:
        pairs: the number of pairs.

    Example:
        >>> test = PairedTest()
        >>> test.add(torch.tensor([-3.0, 1.0]).repeat(32))
        >>> test.decision, [round(end, 2) for end in test.interval]
        ('better', [-1.94, -0.01])
    """

    def __init__(self, alpha: float = 0.05, bound: float | None = None) -> None:
        check_number("alpha", alpha, lambda x: 0 < x < 1, "a probability in (0, 1)")
        if bound is not None:
            check_number("bound", bound, *POSITIVE)
        self.alpha, self._given, self._d = alpha, bound, np.zeros(0)

    @without_gradients
    def add(self, differences: Tensor) -> None:
        """Add the differences ``(n,)`` of new pairs; an infinite one decides, as does a NaN."""
        check_tensor("differences", differences, len(differences), batched=False)
        new = differences.double().cpu().numpy()
        self._d = np.concatenate((self._d, new))

    @property
    def pairs(self) -> int:
        """The number of pairs."""
        return len(self._d)

    @property
    def mean(self) -> float:
        """The mean difference; nan without pairs."""
        return float(self._d.mean()) if self.pairs else math.nan

    @property
    def vetoed(self) -> bool:
        """True if a pair has lost more than the bound before it."""
        return bool((self._d > _bounds(self._d, self._given)[:-1]).any())

    @property
    def interval(self) -> tuple[float, float]:
        """The confidence interval of the mean difference, infinite with fewer than 16 pairs.

        It covers the mean at all n at once with probability 1 - alpha. Its lower end applies the
        bound to gains.
        """
        if self.pairs < FEWEST or not math.isfinite(self.mean):
            return -math.inf, math.inf
        losses, gains = (_Bets(d, self._given) for d in (self._d, -self._d))
        return -gains.end(2 / self.alpha), losses.end(2 / self.alpha)

    @property
    def decision(self) -> str:
        """``"better"`` or ``"worse"`` if the bets or a veto say so, else ``"open"``."""
        if math.isinf(self.mean) or (self.pairs and math.isnan(self.mean)):
            return "better" if self.mean == -math.inf else "worse"
        if self.vetoed:
            return "worse"
        if self.pairs < FEWEST:
            return "open"
        sides = {"better": self._d, "worse": -self._d}
        won = (side for side, d in sides.items() if _Bets(d, self._given).won(2 / self.alpha))
        return next(won, "open")


def _bounds(d: np.ndarray, bound: float | None) -> np.ndarray:
    """Return the bounds on the losses of all pairs and of the next one, ``(n + 1,)``."""
    if bound is not None:
        return np.full(len(d) + 1, bound)
    n, bounds = np.arange(1, len(d) + 1), np.full(len(d) + 1, np.inf)
    with np.errstate(all="ignore"):
        mean, size = np.cumsum(d) / n, np.cumsum(np.abs(d)) / n
        losses, gains = np.maximum.accumulate(d) - mean, mean - np.minimum.accumulate(d)
        bounds[1:] = MULTIPLE * size * np.maximum(losses / gains, 1.0)
        bounds[1:][~(losses + gains > EQUAL * size)] = np.inf  # no spread, no scale
    bounds[:FIRST] = np.inf
    return bounds


class _Bets:
    """Bets against E d >= mean: their wealth increases with the mean."""

    def __init__(self, d: np.ndarray, bound: float | None) -> None:
        bounds = _bounds(d, bound)[:-1]
        self._lost, bet = bool((d > bounds).any()), np.isfinite(bounds)
        self._d, self._bounds = d[bet], bounds[bet]

    def _wealth(self, mean: float) -> float:
        lost = (self._d - mean) / (self._bounds - mean)
        return float(np.prod(1 - STAKES[:, None] * lost, axis=1).mean())

    def won(self, wealth: float) -> bool:
        """Return True if the bets against E d >= 0 have reached a wealth."""
        return not self._lost and self._wealth(0.0) >= wealth

    def end(self, wealth: float) -> float:
        """Return the smallest mean against which the bets have reached a wealth."""
        if self._lost or not len(self._d):
            return math.inf
        low, high = float(self._d.min()), float(self._bounds.min())
        while low < (middle := (low + high) / 2) < high:
            low, high = (low, middle) if self._wealth(middle) >= wealth else (middle, high)
        return high


class Gate:
    """Keeps the best policy so far, and replaces it by a candidate that is shown to cost less.

    Args:
        actor: the first policy; the gate keeps a copy.
        costs: maps a policy and a seed to the costs ``(starts,)`` of closed loops, with starts and
            disturbances from the seed alone.
        pairs: the number of pairs after which an undecided comparison rejects the candidate.
        alpha: the largest probability of ever accepting a candidate that is no better. Comparison
            k, from 1, has the share ``K / ((K + k - 1) (K + k))`` of it; all shares sum to 1.
        decisions: K, the number of comparisons that are planned.
        bound: the largest loss of one closed loop, as in `PairedTest`.
        patience: the number of rejections in a row after which the candidate becomes a copy of the
            policy that is kept; None: never.
        seed: seeds the starts and disturbances of all comparisons.

    Attributes:
        actor: the policy that is kept.
        accepted, rejected: the numbers of decisions.
    """

    def __init__(
        self,
        actor: nn.Module,
        costs: Costs,
        *,
        pairs: int = 96,
        alpha: float = 0.05,
        decisions: int = 10,
        bound: float | None = None,
        patience: int | None = 3,
        seed: int = 0,
    ) -> None:
        check_whole("pairs", pairs, FEWEST)
        if patience is not None:
            check_whole("patience", patience, 1)
        check_seed(seed)
        check_whole("decisions", decisions, 1)
        PairedTest(alpha, bound)
        self.actor, self._costs = copy.deepcopy(actor), costs
        self._decisions, self._bound = decisions, bound
        self._pairs, self._alpha, self._patience, self._seed = pairs, alpha, patience, seed
        self.accepted = self.rejected = self._in_a_row = 0

    @torch.no_grad()
    def judge(self, candidate: nn.Module) -> PairedTest:
        """Compare ``candidate`` with the policy that is kept, on new starts and disturbances.

        Pairs are added until the test is decided, the candidate's mean cost is no lower, or there
        are ``pairs``. The parameters of a candidate that is better are copied to the policy that is
        kept; after ``patience`` rejections in a row it is the other way round.

        Raises:
            QPError: ``costs`` returns another shape than ``(starts,)``.
        """
        test = self._compare(candidate)
        if test.decision == "better":
            self.accepted, self._in_a_row = self.accepted + 1, 0
            self.actor.load_state_dict(candidate.state_dict())
            return test
        self.rejected, self._in_a_row = self.rejected + 1, self._in_a_row + 1
        if self._in_a_row == self._patience:
            candidate.load_state_dict(self.actor.state_dict())
            self._in_a_row = 0
        return test

    def _compare(self, candidate: nn.Module) -> PairedTest:
        k, count = self._decisions + self.accepted + self.rejected, 0
        test = PairedTest(self._alpha * self._decisions / (k * (k + 1)), self._bound)
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
        return test

    def state_dict(self) -> dict[str, Any]:
        """Return the kept policy's parameters and the numbers of decisions."""
        counts = [self.accepted, self.rejected, self._in_a_row]
        return {"actor": self.actor.state_dict(), "counts": counts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a `state_dict`."""
        self.actor.load_state_dict(state["actor"])
        self.accepted, self.rejected, self._in_a_row = state["counts"]
