from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import trim_mean

from torch_qpmpc import QPError
from torch_qpmpc.study.statistics import bootstrap_interval, interquartile_mean, spread, spread_name


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([7.0], 7.0),
        ([1.0, 2.0], 1.5),
        ([0.0, 1.0, 3.0, 1000.0], 2.0),
        # The middle half of six values: two whole ones and half of each neighbour.
        ([0.0, 1.0, 2.0, 4.0, 8.0, 100.0], (0.5 * 1 + 2 + 4 + 0.5 * 8) / 3),
    ],
)
def test_the_middle_half_counts_in_any_order(rng, values, expected):
    assert interquartile_mean(rng.permutation(values)) == pytest.approx(expected)


def test_with_multiples_of_four_it_is_scipys_trimmed_mean(rng):
    x = rng.normal(size=(3, 20, 2))
    np.testing.assert_allclose(interquartile_mean(x, axis=1), trim_mean(x, 0.25, axis=1))


def test_the_interval_of_the_mean_is_the_normal_one(rng):
    x = rng.normal(loc=5.0, scale=2.0, size=400)
    low, high = bootstrap_interval([x], np.mean, level=0.9)
    half = 1.645 * x.std() / np.sqrt(len(x))
    assert low == pytest.approx(x.mean() - half, abs=0.05)
    assert high == pytest.approx(x.mean() + half, abs=0.05)


def test_it_covers_the_truth_at_its_level(rng):
    hits = 0
    for seed in range(200):
        x = rng.normal(size=30)
        low, high = bootstrap_interval([x], np.mean, level=0.8, resamples=300, seed=seed)
        hits += int(low <= 0 <= high)
    assert 0.7 < hits / 200 < 0.88


def test_strata_keep_their_size():
    """Differences between strata do not widen the interval, unlike those within one stratum."""
    strata = [np.zeros(5), np.ones(5)]
    assert bootstrap_interval(strata, np.mean) == (0.5, 0.5)
    low, high = bootstrap_interval([np.concatenate(strata)], np.mean)
    assert low < 0.3 < 0.7 < high


def test_a_stratum_of_one_run_is_in_every_resample(rng):
    assert bootstrap_interval([np.array([0.3])]) == (0.3, 0.3)
    several = rng.normal(size=(9, 2))
    low, high = bootstrap_interval([several, np.full((1, 2), 100.0)], np.mean)
    alone = bootstrap_interval([several], np.mean)
    np.testing.assert_allclose([low, high], 0.9 * np.array(alone) + 10, rtol=1e-12)


def test_curves_have_an_interval_at_each_point(rng):
    x = rng.normal(size=(10, 7))
    low, high = bootstrap_interval([x], interquartile_mean)
    assert low.shape == high.shape == (7,)
    assert (low < interquartile_mean(x)).all()
    assert (interquartile_mean(x) < high).all()


def test_a_seed_gives_one_interval(rng):
    x = rng.normal(size=12)
    assert bootstrap_interval([x], np.mean, seed=3) == bootstrap_interval([x], np.mean, seed=3)
    assert bootstrap_interval([x], np.mean, seed=3) != bootstrap_interval([x], np.mean, seed=4)


@pytest.mark.parametrize("strata", [[], [np.ones(3), np.ones(0)]])
def test_an_empty_stratum_is_refused(strata):
    with pytest.raises(QPError, match=r"strata: got sizes \[.*\], expected at least one run"):
        bootstrap_interval(strata)


def test_three_values_have_a_range_as_an_interval_of_them_misses(rng):
    missed = 0
    for _ in range(200):
        low, high = bootstrap_interval([rng.normal(size=3)], resamples=200)
        missed += not low <= 0 <= high
    assert missed > 0.15 * 200
    x = rng.normal(size=(3, 4))
    low, high, count, few = spread([x])
    np.testing.assert_array_equal((low, high), (x.min(0), x.max(0)))
    assert (count, few) == (3, True)


@pytest.mark.parametrize("sizes", [[6], [9, 6]])
def test_six_values_in_each_stratum_have_an_interval(rng, sizes):
    strata = [rng.normal(size=size) for size in sizes]
    found = spread(strata, np.mean)
    assert found[:2] == bootstrap_interval(strata, np.mean)
    assert found[2:] == (sum(sizes), False)
    assert spread([*strata, strata[0][:5]], np.mean).few


def test_a_spread_is_called_what_it_is():
    assert spread([np.arange(3.0)]).text(".1f") == "(range of 3: 0.0 to 2.0)"
    assert spread([np.full(6, 0.25)]).text() == "[0.250, 0.250]"
    names = [spread_name(counts) for counts in ([3, 5], [6, 10], [3, 10])]
    assert names == ["range", "95% interval", "95% interval (range of fewer than six)"]
