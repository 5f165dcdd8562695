"""The same plant in other units is the same controller: `python -m tests.campaign.units`."""

from typing import Any

import numpy as np
import pytest

import torch_qpmpc as qm
from tests.campaign.units import Units, drawn, judged
from torch_qpmpc import QPError
from torch_qpmpc.control.lowering import riccati
from torch_qpmpc.export.tables import make_tables


def two_by_two(y, u, **options):
    """Return the controller of two coupled signals in units y, with inputs in units u."""
    y, u = np.array(y), np.array(u)
    B = np.array([[0.3, 0.1], [0.05, 0.2]]) * y[:, None] / u
    weights = {"Q": 1 / y**2, "dR": 0.1 / u**2}
    bounds: Any = {"u_bounds": (-3 * u, 3 * u), "y_bounds": (-5 * y, 5 * y)}
    model = np.diag([0.7, 0.8]), B
    return qm.Controller(qm.LinearMPC(model, 10, **{**weights, **bounds, **options}))


@pytest.mark.parametrize(
    ("y", "u", "bounded"), [((1e5, 1e-2), (1e5, 1e-5), True), ((1e-6, 1e4), (1e5, 1e-5), False)]
)
def test_a_set_point_in_any_unit_is_tracked_and_the_design_is_sound(y, u, bounded, tmp_path):
    options = {} if bounded else {"y_bounds": None}
    controller, r = two_by_two(y, u, **options), np.array([1.0, -0.5])
    assert len(controller.mpc.design.steady.W) == 0
    assert np.allclose(controller.mpc.target(r * y).y.numpy() / y, r, atol=1e-9)
    assert controller.review(r * y).faults == []
    assert controller.export_c(tmp_path).difference is not None
    plant, x = controller.mpc.design.plant, np.zeros(2)
    for _ in range(100):
        x = plant.A @ x + plant.B @ controller.step(x, r * y)
    assert np.allclose(x / y, r, atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_noise_costs_the_same_in_any_unit():
    rng, found = np.random.default_rng(0), []
    u, y = rng.uniform(-1, 1, 300), np.zeros((301, 2))
    for k in range(300):
        y[k + 1] = [0.9 * y[k, 0] + 0.1 * y[k, 1], 0.7 * y[k, 1] + u[k]]
    y += 0.05 * rng.normal(size=y.shape)
    for unit in (1.0, 1e-6, 1e6):
        model = qm.identify({"y": y[:, :1] * unit, "u": u}, order=2)
        weights = {"Q": 1 / unit**2, "dR": 0.1, "u_bounds": (-1.0, 1.0)}
        found.append(qm.Controller(qm.LinearMPC(model, 10, **weights)).review()["noise"].text)
    assert found[0] == found[1] == found[2]


def test_a_remedy_names_a_weight_in_each_input_s_own_unit():
    controller = two_by_two((1.0, 1.0), (1.0, 1e3), dR=None)
    singular = qm.LinearMPC(
        ([[0.9]], [[0.5, 4e-4]]), 10, Q=1.0, u_bounds=([-1.0, -1e3], [1.0, 1e3])
    )
    (fault,) = (x for x in qm.Controller(singular).review().faults if x.name == "cost")
    assert "R={'u1': 0.001, 'u2': 1e-09}" in fault.remedy
    assert controller.review()["cost"].ok


@pytest.mark.parametrize(("y", "u", "cost"), [(1.0, 1.0, 1.0), (1e5, 1e-3, 1.0), (1e-4, 1e2, 50.0)])
def test_the_default_price_of_a_violation_is_a_thousand_stages_in_any_unit(y, u, cost):
    def price(**options):
        bounds: Any = {"y_bounds": (-2 * y, 2 * y), "u_bounds": (-3 * u, 3 * u), **options}
        weights = {"R": 0.1 * cost / u**2, **options}
        return qm.LinearMPC(([[0.9]], [[0.5 * y / u]]), 5, **{**bounds, **weights}).design.slack

    assert np.allclose(price(Q=cost / y**2), 1e3 * (4 + 0.9) / 2 * cost / y)
    linear = {"linear": {"u1": 7 * cost / u}, "R": None}
    assert np.allclose(price(**linear), 1e3 * 7 * 3 / 2 * cost / y)
    assert np.allclose(price(Q=cost / y**2, R=None, y_bounds=None), 1e3 * cost**0.5 / y)
    assert price(Q=cost / y**2, y_slack=5.0) == 5.0


def test_a_plant_without_a_steady_state_is_refused_in_any_unit():
    for unit in (1.0, 1e6):
        with pytest.raises(QPError, match="a mode at 1 that no input moves"):
            qm.LinearMPC(([[1.0, 0.0], [0.0, 0.5]], [[0.0], [unit]]), 5, Q=1.0, R=0.1)


@pytest.mark.parametrize("seed", [0, 5, 12, 15, 33, 49, 105, 198])
def test_random_designs_in_random_units_have_the_same_moves(seed):
    assert judged(seed, compiled=seed == 0)[0].startswith("controlled")


@pytest.mark.parametrize("seed", [22, 55])
def test_a_target_whose_value_is_the_rest_of_huge_terms_is_exported(tmp_path, seed):
    design, units = drawn(seed)
    assert qm.export_c(design.made(units).targets, tmp_path).rows == 0


@pytest.mark.parametrize("seed", [0, 57, 63])
def test_the_rows_of_an_export_depend_on_each_other_alike_in_any_unit(seed):
    design, units = drawn(seed)
    one = Units(*(np.ones(len(unit)) for unit in units))
    Q, other = (make_tables(design.made(x).plan).Q for x in (one, units))
    assert np.abs(Q - other).max() < 1e-10


@pytest.mark.parametrize(("x", "u"), [(1e2, (1.0, 1e3)), (1e5, (1e-2, 1e5)), (1e-3, (1.0, 1e5))])
@pytest.mark.parametrize("R", [0.0, 1.0])
def test_the_terminal_weight_is_the_same_in_any_unit(x, u, R):
    found = []
    for x_unit, u_unit in ((1.0, np.ones(2)), (x, np.array(u))):
        model = [[1.2]], np.array([[0.3, 0.2]]) * x_unit / u_unit
        weights = {"Q": 1 / x_unit**2, "R": R / u_unit**2, "dR": [0.1, 0.05] / u_unit**2}
        mpc = qm.LinearMPC(model, 5, **weights, u_bounds=(-u_unit, u_unit))
        P, size = riccati(mpc.design), np.append(x_unit, u_unit)
        found.append(None if P is None else P * np.outer(size, size))
    assert (found[0] is None) == (found[1] is None) == (R == 0)
    assert R == 0 or np.allclose(*found, rtol=1e-9)
