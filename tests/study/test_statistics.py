import numpy as np
import pytest
from scipy.stats import trim_mean

from torch_qpmpc import QPError
from torch_qpmpc.study.statistics import interquartile_mean, spread


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
    low, high, *_ = spread([x], np.mean)
    half = 1.96 * x.std() / np.sqrt(len(x))
    assert (low, high) == pytest.approx((x.mean() - half, x.mean() + half), abs=0.05)


def test_strata_keep_their_size():
    """Differences between strata do not widen the interval, unlike those within one stratum."""
    strata = [np.zeros(6), np.ones(6)]
    assert spread(strata, np.mean)[:2] == (0.5, 0.5)
    low, high, *_ = spread([np.concatenate(strata)], np.mean)
    assert low < 0.3 < 0.7 < high


def test_curves_have_an_interval_at_each_point(rng):
    x = rng.normal(size=(10, 7))
    low, high, *_ = spread([x], interquartile_mean)
    assert low.shape == high.shape == (7,)
    assert ((low < interquartile_mean(x)) & (interquartile_mean(x) < high)).all()


def test_an_empty_stratum_is_refused():
    with pytest.raises(QPError, match=r"strata: got sizes \[3, 0\], expected at least one run"):
        spread([np.ones(3), np.ones(0)])


def test_fewer_than_six_values_in_a_stratum_have_a_range(rng):
    x = rng.normal(size=(3, 4))
    low, high, count, few = spread([x])
    np.testing.assert_array_equal((low, high), (x.min(0), x.max(0)))
    assert (count, few) == (3, True)
    assert not spread([rng.normal(size=6)]).few
    assert spread([rng.normal(size=9), rng.normal(size=5)], np.mean).few


def test_a_spread_is_called_what_it_is():
    assert spread([np.arange(3.0)]).text(".1f") == "(range of 3: 0.0 to 2.0)"
    assert spread([np.full(6, 0.25)]).text() == "[0.250, 0.250]"
