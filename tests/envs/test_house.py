"""The heated houses: physics, tariff, comfort band, weather, gain and cost."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torch_qpmpc as qm
from torch_qpmpc.envs import House, HouseWall
from torch_qpmpc.envs.heated_house import DT, GAIN, LOWER, OUTDOOR, PRICE, UPPER
from torch_qpmpc.envs.house_wall import SUN

HOUSES = [House(), HouseWall()]


def signals(house, count=3, length=200, seed=0):
    return house.signals(np.random.default_rng(seed), count, length)


def at(house, hour, position):
    """Return a signal at an hour of the first day."""
    return signals(house)[0, int(hour / DT), position].item()


def test_a_room_takes_one_step_of_its_difference_equation():
    w = signals(House())[:, 70]
    T, q = torch.tensor([[19.0], [15.0], [21.5]]).double(), torch.tensor([[0.0], [3.0], [12.0]])
    outdoor, gain = w[:, OUTDOOR : OUTDOOR + 1], w[:, GAIN:]
    expected = T + 0.25 * ((outdoor - T) / (1.4 * 1.5) + (q + gain) / 1.5)
    torch.testing.assert_close(House().step(T, q, w), expected)


def test_a_house_with_a_wall_follows_its_differential_equation():
    """Integrates in SI units: W, J, K and s."""
    house, x, q = HouseWall(), torch.tensor([18.0, 40.0, 15.0]).double(), 2.5
    w = signals(house)[1, 48]
    outdoor, sun, gain = (w[i].item() for i in (OUTDOOR, SUN, GAIN))

    def slope(_, x):
        T_i, T_h, T_e = x
        from_heater, from_wall = (T_h - T_i) / 0.0761996125919563, (T_e - T_i) / 0.00135151763922409
        heat = 10.1265729225269 * 1000 * sun + 1000 * gain
        return [
            (from_heater + from_wall + heat) / 1914908.30860716,
            (-from_heater + 1000 * q) / 4015.39425109821,
            (-from_wall + (outdoor - T_e) / 0.00751396226986365) / 15545663.6743828,
        ]

    end = solve_ivp(slope, (0, 900), x.numpy(), method="LSODA", rtol=1e-12, atol=1e-12).y[:, -1]
    following = house.step(x, torch.tensor([q]), w)
    torch.testing.assert_close(following, torch.as_tensor(end), rtol=1e-9, atol=1e-9)
    assert house.output(x, w).item() == 18.0


@pytest.mark.parametrize("house", HOUSES)
@pytest.mark.parametrize(
    ("hour", "price"), [(0, 0.15), (6.75, 0.15), (7, 0.35), (8.75, 0.35), (9, 0.15), (17, 0.35)]
)
def test_prices_peak_in_the_morning_and_in_the_evening(house, hour, price):
    assert at(house, hour, PRICE) == at(house, hour + 24, PRICE) == pytest.approx(price)
    assert at(house, 19.75, PRICE) > at(house, 20, PRICE)


@pytest.mark.parametrize("house", HOUSES)
def test_the_comfort_band_is_wider_at_night(house):
    lower = {hour: at(house, hour, LOWER) for hour in (0, 7.75, 8, 21.75, 22, 31.75, 32)}
    assert list(lower.values()) == [12.0, 12.0, 17.0, 17.0, 12.0, 12.0, 17.0]
    assert at(house, 12, UPPER) == house.upper == (21.0 if isinstance(house, House) else 22.0)


@pytest.mark.parametrize("house", HOUSES)
def test_the_cost_is_the_heat_s_price_and_the_discomfort(house):
    w = signals(house)[0, [0, 40, 72]]
    air = torch.tensor([11.0, 17.0, 23.0]).double()
    x = house.starts(np.random.default_rng(), 3)
    x[:, 0] = air
    u = torch.tensor([[2.0], [4.0], [1.0]]).double()
    discomfort = torch.tensor([1.0, 0.0, 23.0 - house.upper]).double()
    torch.testing.assert_close(house.violation(x, w), discomfort)
    expected = 0.25 * (torch.tensor([0.30, 0.60, 0.35]).double() + discomfort)
    torch.testing.assert_close(house.cost(x, u, w), expected)


def test_the_tutorial_s_weather_is_one_day_s():
    """Compares with the tutorial's own formula for one day and a forecast of 32 steps."""
    hour = np.arange(129) * 0.25 % 24
    bumps, kernel = np.random.default_rng(0).normal(0.0, 1.0, 129), np.hanning(8)
    expected = 8 + 6 * np.sin(2 * np.pi * (hour - 9) / 24)
    expected = expected + np.convolve(bumps, kernel / kernel.sum(), mode="same")
    outdoor = House().weather(torch.as_tensor(bumps).view(-1, 1, 1))[..., 0]
    torch.testing.assert_close(outdoor, torch.as_tensor(expected).unsqueeze(0))
    assert not torch.equal(*signals(House(), count=2)[..., OUTDOOR])


@pytest.mark.parametrize("house", HOUSES)
def test_the_gain_is_an_evening_s_and_a_correlated_random_part(house):
    gain = signals(house, count=2000, length=96)[..., GAIN]
    evening = gain[:, 72:88].mean().item()
    assert evening == pytest.approx(house.evening_gain, abs=0.02)
    assert gain[:, 40:72].mean().item() == pytest.approx(0, abs=0.02)
    random = gain - gain.mean(0)
    assert random[:, -1].std().item() == pytest.approx(house.gain_std, rel=0.05)
    correlation = (random[:, -1] * random[:, -2]).mean() / random[:, -2].square().mean()
    assert correlation.item() == pytest.approx(0.9, abs=0.02)
    assert gain[:, 0].abs().max() == 0


def test_each_day_of_the_house_with_a_wall_has_its_own_weather():
    w = signals(HouseWall(), count=500, length=4 * 96)
    outdoor, sun = w[..., OUTDOOR], w[..., SUN]
    by_day = outdoor.unflatten(1, (4, 96))
    assert outdoor.mean().item() == pytest.approx(2, abs=0.3)
    assert outdoor.diff(dim=1).abs().max() < 0.6  # continuous at midnight, too
    assert by_day[:, 1:, 0].std().item() == pytest.approx(3, rel=0.15)
    peak = sun.unflatten(1, (4, 96)).amax(-1)
    assert 0 <= peak.min() < 0.01
    assert 0.24 < peak.max() <= 0.25
    night = sun.unflatten(1, (4, 96))[..., :32]
    assert (night == 0).all()


@pytest.mark.parametrize("house", HOUSES)
def test_a_longer_draw_extends_the_same_days(house):
    short, long = signals(house, length=100), signals(house, length=300)
    # The last three outdoor temperatures of a room are smoothed with numbers that follow.
    assert torch.equal(short[:, :96], long[:, :96])
    assert not torch.equal(short, signals(house, length=100, seed=1))


@pytest.mark.parametrize("house", HOUSES)
def test_training_and_evaluation_days_differ_with_the_same_seed(house):
    """The environments draw by torch's generator, `plant_loop` by NumPy's."""
    env = house.vectorised(4, 96, seed=123)
    prices = env.reset()["preview"].unflatten(-1, (-1, house.n_d))
    evaluation = house.signals(np.random.default_rng(123), 32, 129)[:, :33, : house.n_d].float()
    distance = (prices.unsqueeze(1) - evaluation).abs().amax((-1, -2))
    assert distance.min() > 1e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"R": 0.0}, "R"),
        ({"C": -1.0}, "C"),
        ({"gain_std": -0.1}, "gain_std"),
        ({"evening_gain": np.inf}, "evening_gain"),
    ],
)
def test_an_impossible_house_is_refused(options, message):
    with pytest.raises(qm.QPError, match=message):
        House(**options)
