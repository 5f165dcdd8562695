"""The designs that `improve` is compared with, on plants that have a closed form."""

import numpy as np
import pandas as pd
import torch

import torch_qpmpc as qm
from tests.benchmarks.rivals import HORIZON, ONE_SIDED, Balance, compared, regulator, shown
from torch_qpmpc.mpc.riccati import lqr_gain


def test_for_constant_noise_and_a_symmetric_cost_the_regulator_is_the_quadratic_one():
    rng, y = np.random.default_rng(0), [np.zeros(1)]
    u = rng.uniform(-1, 1, (800, 1))
    for k in range(800):
        y.append(0.9 * y[-1] + 0.5 * u[k] + 0.05 * rng.standard_normal(1))
    found = qm.identify({"y": np.array(y), "u": u}, HORIZON, order=0)
    law = regulator(Balance(price=ONE_SIDED._replace(above=0.0)), found)
    W = torch.diag(torch.tensor([2.0, 0.2]).double())
    expected = lqr_gain(torch.tensor(found.model.A), torch.tensor(found.model.B), W)
    np.testing.assert_allclose(law.K, expected.numpy(), rtol=1e-3)
    np.testing.assert_allclose(law.x_s, 0, atol=1e-3)
    np.testing.assert_allclose(law.price, (0, 1, 0, 0, 0, 0.1), atol=1e-3)


def test_a_cell_says_on_how_many_seeds_improve_costs_less():
    J = {"improve": 1.0, "mean": 2.0, "Riccati": 1.0}
    rows = [
        {"plant": "one", "transitions": 500, "seed": seed, "design": design, "J": x + seed * bump}
        for seed in range(10)
        for (design, x), bump in zip(J.items(), (0.01, 0.02, 0.01 * (-1) ** seed), strict=True)
    ]
    for one in rows:
        one["kept"] = one["seed"] > 2 if one["design"] == "improve" else None
    marks = compared(pd.DataFrame(rows))
    assert marks["one", "mean", 500] == "/10*"
    assert not marks["one", "Riccati", 500].endswith("*")
    text = shown(pd.DataFrame(rows))
    assert "| mean | 2.09/2.18/10* |" in text
    assert "| kept, dearer, most | 7/0/-50.0% |" in text
    left = {one: [x for x in rows if x["design"] != one] for one in ("improve", "mean")}
    assert "| mean | 2.09/2.18 |" in shown(pd.DataFrame(left["improve"]))
    assert "kept" not in shown(pd.DataFrame(left["mean"]))
