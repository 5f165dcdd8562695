from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from torch_qpmpc import QPError
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


def test_the_interval_is_that_of_the_formula():
    d = normal(50, 0.3, 0)
    test = PairedTest(0.1, narrowest=20)
    test.add(d[:20])
    test.add(d[20:])
    n, a = 50, -2 * math.log(0.1)
    rho = math.sqrt((a + math.log(1 + a)) / 20)
    root = math.sqrt(2 * (n * rho**2 + 1) / (n * rho) ** 2)
    half = d.std().item() * root * math.sqrt(math.log(math.sqrt(n * rho**2 + 1) / 0.1))
    low, high = test.interval
    assert low == pytest.approx(d.mean().item() - half)
    assert high == pytest.approx(d.mean().item() + half)


def test_the_interval_covers_the_mean_at_all_times():
    """Of 400 sequences, looked at after each 8 pairs up to 400, at most 5 % miss the mean."""
    missed = 0
    for seed in range(400):
        test, d = PairedTest(0.05), normal(400, 0.0, seed)
        decisions = set()
        for part in d.split(8):
            test.add(part)
            decisions.add(test.decision)
        missed += decisions != {"open"}
    assert missed <= 0.05 * 400


@pytest.mark.parametrize(("mean", "decision"), [(-1.0, "better"), (1.0, "worse"), (0.0, "open")])
def test_decisions(mean, decision):
    test = PairedTest()
    test.add(normal(64, mean, 1))
    assert test.decision == decision


def test_few_pairs_decide_nothing():
    test = PairedTest()
    test.add(torch.full((15,), -5.0))
    assert test.decision == "open"
    test.add(torch.tensor([-5.0]))
    assert test.decision == "better"


@pytest.mark.parametrize(
    ("value", "decision"), [(math.inf, "worse"), (math.nan, "worse"), (-math.inf, "better")]
)
def test_a_policy_that_fails_is_worse(value, decision):
    test = PairedTest()
    test.add(torch.tensor([value]))
    assert test.decision == decision


def test_an_empty_test_is_open():
    test = PairedTest()
    assert math.isnan(test.mean)
    assert test.decision == "open"


def test_a_better_candidate_acts():
    gate, candidate = Gate(Policy(2.0), costs), Policy(1.0)
    verdict = gate.judge(candidate)
    assert verdict.accepted
    assert verdict.high < 0
    assert gate.actor.level == 1.0
    assert (gate.accepted, gate.rejected) == (1, 0)


@pytest.mark.parametrize("level", [2.0, 2.5])
def test_any_other_candidate_does_not(level):
    gate = Gate(Policy(2.0), costs)
    verdict = gate.judge(Policy(level))
    assert not verdict.accepted
    assert gate.actor.level == 2.0
    assert verdict.pairs == 32


def test_an_undecided_comparison_ends_in_a_rejection():
    def unpaired(policy: nn.Module, seed: int) -> Tensor:
        assert isinstance(policy, Policy)
        level = policy.level.item()
        return normal(32, level, seed + int(100 * level))

    verdict = Gate(Policy(2.0), unpaired, seed=1).judge(Policy(1.9))
    assert not verdict.accepted
    assert verdict.low < verdict.mean < 0 < verdict.high
    assert verdict.pairs == 96


def test_after_rejections_in_a_row_the_candidate_starts_from_the_acting_policy():
    gate, candidate = Gate(Policy(2.0), costs, patience=2), Policy(3.0)
    assert not gate.judge(candidate).restarted
    assert candidate.level == 3.0
    assert gate.judge(candidate).restarted
    assert candidate.level == 2.0


def test_the_acting_policy_is_a_copy():
    candidate = Policy(2.0)
    gate = Gate(candidate, costs)
    with torch.no_grad():
        candidate.level.fill_(5.0)
    assert gate.actor.level == 2.0


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


def test_the_state_is_restored():
    gate, other = Gate(Policy(2.0), costs), Gate(Policy(2.0), costs)
    gate.judge(Policy(1.0))
    gate.judge(Policy(3.0))
    other.load_state_dict(gate.state_dict())
    assert other.actor.level == 1.0
    assert other.judge(Policy(3.0)) == gate.judge(Policy(3.0))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: PairedTest(0.0), "alpha"),
        (lambda: PairedTest(narrowest=0), "narrowest"),
        (lambda: PairedTest().add(torch.zeros(2, 2)), "differences"),
        (lambda: Gate(Policy(1.0), costs, pairs=8), "pairs"),
        (lambda: Gate(Policy(1.0), costs, alpha=1.0), "alpha"),
        (lambda: Gate(Policy(1.0), costs, patience=0), "patience"),
        (lambda: Gate(Policy(1.0), costs, seed=-1), "seed"),
        (lambda: Gate(Policy(1.0), lambda *_: torch.zeros(())).judge(Policy(1.0)), "costs"),
    ],
)
def test_errors(call, message):
    with pytest.raises(QPError, match=message):
        call()
