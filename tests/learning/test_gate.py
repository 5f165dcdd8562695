import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.refused import refused
from torch_qpmpc.learning.gate import Gate, PairedTest


class Policy(nn.Module):
    """A policy whose closed loops cost ``level`` plus noise that depends on the seed alone."""

    def __init__(self, level: float) -> None:
        super().__init__()
        self.level = nn.Parameter(torch.tensor(level, dtype=torch.float64))


def costs(policy: nn.Module, seed: int) -> Tensor:
    assert isinstance(policy, Policy)
    noise = torch.randn(32, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return policy.level.detach() * (1 + 0.1 * noise) + noise


def normal(n: int, mean: float, seed: int) -> Tensor:
    return mean + torch.randn(n, generator=torch.Generator().manual_seed(seed)).double()


def test_the_interval_ends_where_the_bets_refute_the_mean():
    d = normal(50, 0.3, 0)
    test = PairedTest(0.1, bound=6.0)
    test.add(d[:20])
    test.add(d[20:])

    def wealth(losses: Tensor, mean: float) -> float:
        stakes = torch.tensor([0.25, 0.5, 1.0]).double()[:, None]
        return (1 - stakes * (losses - mean) / (6.0 - mean)).prod(1).mean().item()

    low, high = test.interval
    assert low < 0.3 < high
    assert wealth(d, high) == pytest.approx(2 / 0.1)
    assert wealth(-d, -low) == pytest.approx(2 / 0.1)


def test_the_bound_comes_from_earlier_pairs_and_grows_with_the_tail_of_losses():
    d = torch.cat((normal(30, 0.0, 0), torch.tensor([3.0])))
    ratio = (d.max() - d.mean()) / (d.mean() - d.min())
    assert ratio > 1
    bound = 5 * d.abs().mean() * ratio
    for earlier, loss, vetoed in ((d[:7], 1e9, False), (d, 0.999, False), (d, 1.001, True)):
        test = PairedTest()
        test.add(torch.cat((earlier, (loss * bound)[None])))
        assert test.vetoed is vetoed


#: Candidates that are no better: the mean difference is zero, with losses in the tail.
NO_BETTER = {
    "normal": lambda n, g: torch.randn(n, generator=g),
    "lognormal 2": lambda n, g: (2 * torch.randn(n, generator=g)).exp() - math.exp(2.0),
    "fails 1 in 200": lambda n, g: (torch.rand(n, generator=g) < 0.005).double() - 0.005,
}
TESTS = 150
LOOKS = {"batches": range(32, 97, 32), "pairs": range(16, 201, 23)}


@pytest.mark.parametrize("family", NO_BETTER)
def test_a_candidate_that_is_no_better_is_accepted_with_probability_alpha_at_most(family):
    looks = LOOKS["batches" if family == "lognormal 2" else "pairs"]
    assert accepted(NO_BETTER[family], looks, None) <= 0.05 * TESTS


def test_a_bound_covers_failures_that_are_hidden_by_noise():
    """Beside noise they leave no trace: with a bound only is the test right."""
    rate = 0.005

    def fails(n: int, g: torch.Generator) -> Tensor:
        noise = 0.1 * rate * torch.randn(n, generator=g)
        return (torch.rand(n, generator=g) < rate).double() - rate + noise

    assert accepted(fails, LOOKS["batches"], 1.1) <= 0.05 * TESTS
    assert accepted(fails, LOOKS["batches"], None) > 0.2 * TESTS


def accepted(draw: Any, looks: range, bound: float | None, count: int = TESTS) -> int:
    better, generator = 0, torch.Generator().manual_seed(0)
    for _ in range(count):
        test, d, seen = PairedTest(bound=bound), draw(max(looks), generator).double(), 0
        for look in looks:
            test.add(d[seen:look])
            seen = look
            if test.decision != "open":
                break
        better += test.decision == "better"
    return better


@pytest.mark.parametrize(("effect", "share"), [(0.3, 0.27), (0.5, 0.85), (1.0, 0.99)])
def test_a_better_candidate_is_accepted_within_96_pairs(effect, share):
    def draw(n: int, g: torch.Generator) -> Tensor:
        return torch.randn(n, generator=g) - effect

    assert accepted(draw, LOOKS["batches"], None, 300) >= share * 300


@pytest.mark.parametrize("bound", [None, 20.0])
def test_a_pair_that_loses_more_than_the_bound_is_a_veto(bound):
    test = PairedTest(bound=bound)
    test.add(normal(64, -1.0, 1))
    assert test.decision == ("better" if bound is None else "open")
    assert not test.vetoed
    test.add(torch.tensor([25.0]))
    assert test.vetoed
    test.add(normal(200, -1.0, 2))
    assert test.decision == "worse"


@pytest.mark.parametrize(
    ("value", "count", "bound", "decision"),
    [
        (-0.5, 40, None, "open"),  # equal differences say nothing without a bound
        (-0.5, 40, 1.0, "better"),
        (-5.0, 15, 5.0, "open"),  # few pairs decide nothing
        (-5.0, 16, 5.0, "better"),
        (math.inf, 1, None, "worse"),  # a policy that fails is worse
        (math.nan, 1, None, "worse"),
        (-math.inf, 1, None, "better"),
    ],
)
def test_equal_differences_decide(value, count, bound, decision):
    test = PairedTest(bound=bound)
    test.add(torch.full((count,), value))
    assert test.decision == decision


@pytest.mark.parametrize(("level", "better"), [(1.0, True), (2.0, False), (2.5, False)])
def test_a_candidate_is_kept_if_it_is_better(level, better):
    gate = Gate(Policy(2.0), costs)
    test = gate.judge(Policy(level))
    assert (test.decision == "better") == (test.interval[1] < 0) == better
    assert gate.actor.level == (level if better else 2.0)
    assert (gate.accepted, gate.rejected) == (better, not better)
    assert test.pairs == (96 if better else 32)


def test_an_undecided_comparison_ends_in_a_rejection():
    def unpaired(policy: nn.Module, seed: int) -> Tensor:
        assert isinstance(policy, Policy)
        level = policy.level.item()
        return normal(32, level, seed + int(100 * level))

    test = Gate(Policy(2.0), unpaired, seed=1).judge(Policy(1.9))
    assert test.decision == "open"
    low, high = test.interval
    assert low < test.mean < 0 < high
    assert test.pairs == 96


def test_after_rejections_in_a_row_the_candidate_starts_from_what_is_kept():
    gate, candidate = Gate(Policy(2.0), costs, patience=2), Policy(3.0)
    gate.judge(candidate)
    assert candidate.level == 3.0
    gate.judge(candidate)
    assert candidate.level == 2.0


def test_comparisons_have_seeds_of_their_own():
    seeds = []

    def recorded(policy: nn.Module, seed: int) -> Tensor:
        seeds.append(seed)
        return costs(policy, seed)

    gate = Gate(Policy(2.0), recorded)
    gate.judge(Policy(2.5))
    gate.judge(Policy(2.5))
    assert len(set(seeds)) == 2
    assert len(seeds) == 4


def test_the_comparisons_of_a_run_share_one_alpha():
    gate, shares = Gate(Policy(2.0), costs, decisions=3), []
    for _ in range(4):
        shares.append(gate.judge(Policy(2.5)).alpha)
    assert shares == [pytest.approx(0.05 * 3 / (k * (k + 1))) for k in (3, 4, 5, 6)]
    assert sum(3 / (k * (k + 1)) for k in range(3, 100_000)) == pytest.approx(1, abs=1e-4)
    resumed = Gate(Policy(2.0), costs, decisions=3)
    resumed.load_state_dict(gate.state_dict())
    assert resumed.judge(Policy(2.5)).alpha == gate.judge(Policy(2.5)).alpha


def test_the_state_is_restored():
    gate, other = Gate(Policy(2.0), costs), Gate(Policy(2.0), costs)
    gate.judge(Policy(1.0))
    gate.judge(Policy(3.0))
    other.load_state_dict(gate.state_dict())
    assert other.actor.level == 1.0
    assert other.judge(Policy(3.0)).interval == gate.judge(Policy(3.0)).interval


@refused(
    (lambda: PairedTest(0.0), "alpha"),
    (lambda: PairedTest(bound=-1.0), r"bound: got -1.0, expected a finite number > 0"),
    (lambda: Gate(Policy(1.0), costs, decisions=0), "decisions"),
    (lambda: PairedTest().add(torch.zeros(2, 2)), "differences"),
    (lambda: Gate(Policy(1.0), costs, pairs=8), "pairs"),
    (lambda: Gate(Policy(1.0), costs, patience=0), "patience"),
    (lambda: Gate(Policy(1.0), costs, seed=-1), "seed"),
    (lambda: Gate(Policy(1.0), lambda *_: torch.zeros(())).judge(Policy(1.0)), "costs"),
)
def test_errors(call):
    call()
