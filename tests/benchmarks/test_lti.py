"""Our side of the comparison with mpcrl on short runs, and its table on made-up results."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.lti import SINGLE, TD, Stream, run, tables


def test_streams_depend_on_the_noise_and_the_learner() -> None:
    fixed, again, learned = run(1, 60, learn=False), run(1, 60), run(1, 60)
    np.testing.assert_array_equal(again.costs, learned.costs)
    assert fixed.costs[0] == learned.costs[0]
    assert (fixed.costs[-30:] != learned.costs[-30:]).all()
    assert run(2, 60).costs[1] != learned.costs[1]


@pytest.mark.parametrize("overrides", [SINGLE, TD], ids=["each step", "TD"])
def test_other_updates_learn_within_some_hundred_steps(overrides: tuple[str, ...]) -> None:
    fixed, learned = run(2, 500, learn=False), run(2, 500, overrides)
    assert fixed.costs[-100:].sum() > 2 * learned.costs[-100:].sum() > 0
    assert fixed.violations.sum() > 2 * learned.violations.sum() >= 0


def test_the_table_has_each_seed_and_the_median() -> None:
    def stream(cost: float) -> Stream:
        return Stream(np.full(1000, cost), np.full(1000, 0.001), 2.0)

    text = tables({"mpcrl": [stream(1.0), stream(3.0)], "ours": [stream(0.5)] * 2}, [69, 1])
    assert "| total cost | seed 69 | seed 1 | median |" in text
    assert "| mpcrl | 1,000 | 3,000 | 2,000 |" in text
    assert "| ours | 0.5000 | 0.5000 | 0.5000 |" in text
    assert "| mpcrl | 1.00 | 1.00 | 1.00 |" in text
    assert "| ours | 2.00 | 2.00 | 2.00 |" in text
