"""Models identified from logs, and QPs that start from them."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.logs import arx_log, room
from tests.refused import refused
from torch_qpmpc import QPMPC, QPError

N = 6
COST: Any = {"stage_weight": [1.0, 1.0, 0.1], "action_bounds": ([-1.0], [1.0]), "solver": "daqp"}


def lag_log(noise: float = 0.0, steps: int = 120) -> TensorDict:
    draw = torch.Generator().manual_seed(0)
    A, B = torch.tensor([[0.9, 0.2], [-0.1, 0.7]]).double(), torch.tensor([[0.5], [1.0]]).double()
    u, e = (torch.randn(steps, n, generator=draw, dtype=torch.float64) for n in (1, 2))
    y = [torch.zeros(2, dtype=torch.float64)]
    for k in range(steps):
        y.append(A @ y[-1] + B @ u[k] + 0.3 + noise * e[k])
    y = torch.stack(y)
    reward = -y[:-1].square().sum(-1, keepdim=True) - 0.1 * u.square()
    following = {"observation": y[1:], "reward": reward}
    return TensorDict({"observation": y[:-1], "action": u, "next": following}, [steps])


# QPMPC.from_data


@pytest.mark.parametrize("structure", ["free", "tied"])
def test_a_qp_starts_from_the_model_of_the_outputs(structure):
    mpc = QPMPC.from_data(lag_log(), N, structure=structure, **COST)
    assert (mpc.n_x, mpc.n_u, mpc.horizon, mpc.n_d) == (2, 1, N, 0)
    assert mpc.structure == structure
    assert torch.equal(mpc.C, mpc.C_0)
    s = torch.tensor([[1.0, -2.0]]).double()
    x, u = (part[0] for part in mpc.predicted(mpc.solve(s).z))
    A, B = torch.tensor([[0.9, 0.2], [-0.1, 0.7]]).double(), torch.tensor([[0.5], [1.0]]).double()
    assert_close(x[1:], x[:-1] @ A.mT + u @ B.mT + 0.3, rtol=1e-7, atol=1e-7)


def test_a_qp_of_an_identification_acts_on_its_states():
    found = qm.identify(arx_log(noise=0.2, steps=200), N, n_d=1, order=5)
    n = len(found.model.A)
    mpc = QPMPC.of(**found.arguments, stage_weight=[1.0] * n + [0.1], structure="tied")
    assert (mpc.n_x, mpc.n_d) == (n, 1)
    for part, matrix in zip(mpc.model(), found.model[:2], strict=False):
        assert_close(part, torch.tensor(matrix))


# The report


@pytest.mark.usefixtures("rough_fits")
def test_the_report_is_printed():
    text = str(qm.identify(lag_log(noise=0.2), N))
    signals, order, white, head, *rows = text.splitlines()
    assert signals == "120 steps: outputs y1, y2; inputs u1; known "[: len(signals)]
    assert order.startswith("Model of order 2 with poles of sizes 0.8")
    assert white.startswith("Autocorrelations of the residuals in their 95 % bound: ")
    assert head.split() == ["steps", "RMSE", "of", "y1,", "y2", "R2,", "cross-validated"]
    assert [int(row.split()[0]) for row in rows] == [1, 2, 5, 6]
    assert all(len(row.split()) == 5 for row in rows)


@pytest.mark.usefixtures("rough_fits")
@pytest.mark.parametrize(
    ("late", "unit", "noise"), [(0, 1.0, 0.1), (0, 1.0, 0.0), (1, 1.0, 0.1), (1, 1e6, 0.1)]
)
def test_the_report_says_that_inputs_are_logged_a_row_late(late, unit, noise):
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 302), np.zeros(302)
    for k in range(301):
        y[k + 1] = 0.8 * y[k] + 0.5 * u[k] + noise * rng.normal()
    found = qm.identify({"y": unit * y[late:300], "u": u[: 300 - late]}, N)
    said = re.search(
        r"The inputs of a row explain (\d+)% of the residuals of its y\..* up a row", str(found)
    )
    assert (said is not None) == (late == 1)
    assert said is None or int(said[1]) > 50


@pytest.mark.usefixtures("rough_fits")
@pytest.mark.parametrize("held", [True, False])
def test_the_report_says_that_a_loop_at_one_set_point_shows_no_effect_of_its_inputs(held):
    rng, sum_of_errors, x = np.random.default_rng(0), 0.0, 0.0
    u, y, r = np.zeros(400), np.zeros(401), np.zeros(400)
    r = r if held else rng.uniform(-3, 3, 20).repeat(20)
    for k in range(401):
        y[k] = x + 0.05 * rng.normal()
        if k < 400:
            sum_of_errors += 0.05 * (r[k] - y[k])
            u[k] = 0.5 * (r[k] - y[k]) + sum_of_errors
            x = 0.9 * x + 0.2 * u[k] + 0.05 * rng.normal()
    said = re.search(
        r"explain (\d+)% of the residuals of its y.*add a random",
        str(qm.identify({"y": y, "u": u}, N)),
    )
    assert (said is not None) == held
    assert said is None or int(said[1]) > 98


@pytest.mark.filterwarnings("error")
def test_single_steps_are_not_said_to_be_late():
    """Their inputs have no outputs of the same row that the model predicts."""
    rng = np.random.default_rng(0)
    logs = []
    for y, u, e in rng.normal(size=(100, 3)):
        logs.append({"y": np.array([y, 0.9 * y + 0.5 * u + 0.1 * e]), "u": np.array([u])})
    text = str(qm.identify(logs, 1))
    assert "Model of order 1" in text
    assert "up a row" not in text


@pytest.mark.usefixtures("rough_fits")
def test_errors_are_those_of_data_that_the_fit_has_not_seen():
    found = qm.identify(lag_log(noise=0.2, steps=400), N)
    assert found.errors.shape[1:] == (N, 2)
    assert_close(found.rmse[0], torch.full((2,), 0.2).double(), rtol=0.15, atol=0)
    assert_close(torch.tensor(found.model.S), 0.04 * torch.eye(2).double(), rtol=0, atol=0.01)
    assert ((found.R2 > 0.5) & (found.R2 < 1)).all()


@pytest.mark.usefixtures("rough_fits")
def test_a_collinear_output_leaves_the_predictions_as_good():
    log = lag_log(noise=0.2, steps=200)
    twice: Any = log.clone()
    for steps in (twice, twice["next"]):
        y = steps["observation"]
        steps["observation"] = torch.cat((y, 3 * y[..., :1] - y[..., 1:]), -1)
    one, both = (qm.identify(x, N) for x in (log, twice))
    assert_close(both.rmse[:, :2], one.rmse, rtol=0.1, atol=0)


def test_a_simulation_is_the_plant_without_corrections():
    log = qm.read_log(room(), outputs=["T"], inputs=["q"], known=["T_out"])
    found, (y, u, d) = qm.identify(log, 4), log.trajectories[0]
    assert_close(found.simulate(u, y[:1], d), y)
    assert_close(found.simulate(u[:1], y[:2], d[:1]), y[:2])
    assert 0 < (found.simulate(u, y[:1] + 1, d) - y)[-1].abs() < 0.01, "it forgets its start"
    for name, wrong in {"u": (u[:, :0], y[:1], d), "y": (u, y[0], d), "d": (u, y[:1])}.items():
        with pytest.raises(QPError, match=rf"^{name}: got shape \(.*\), expected \("):
            found.simulate(*wrong)
    for name, words in {"u": ("on", y, d), "y": (u, {"T": 1}, d), "d": (u, y, [["a"]])}.items():
        with pytest.raises(QPError, match=f"^{name}: got (str|dict|list), expected an array of"):
            found.simulate(*words)
    with pytest.raises(QPError, match=r"^u: got shape \(\), expected"):
        found.simulate(3.0, y[:1])


# Bad data


def frozen_action(log: TensorDict) -> TensorDict:
    log["action"] = torch.full_like(log["action"], 0.3)
    return log


def feedback(log: TensorDict) -> TensorDict:
    log["action"] = log["observation"][..., :1] - 0.5 * log["observation"][..., 1:] + 1
    return log


def discrete_actions(log: TensorDict) -> TensorDict:
    log["action"] = torch.nn.functional.one_hot((log["action"] > 0).long().squeeze(-1), 2).double()
    return log


@refused(
    (
        lambda: qm.identify(lag_log(steps=4), N),
        "trajectories: got 4 transitions in 1 trajectory, expected at least 5 for .* Log mo",
    ),
    (
        lambda: qm.identify(frozen_action(arx_log()), N),
        "action: got u1 constant at 0.3, expected one that moves. Add a random signal",
    ),
    (lambda: qm.identify(feedback(arx_log()), N), "action: got u1 a linear function of the output"),
    (
        lambda: qm.identify(discrete_actions(arx_log()), N),
        "action: got one-hot vectors of discrete ones, expected continuous actions",
    ),
    (lambda: qm.identify(arx_log(), 0), "horizon: got 0, expected a whole number >= 1"),
    (lambda: qm.identify(arx_log(), order=-1), "order: got -1, expected a whole number >= 0"),
    (lambda: qm.identify(arx_log(), N, n_x=3), r"observation: got shape \(3, 40, 2\), expected"),
)
def test_a_mistake_is_named(call):
    call()


def test_a_log_too_short_for_any_order_is_told():
    """Windows of two steps must be in half of the steps, and twice as many as their entries."""
    with pytest.warns(UserWarning, match="order: 8 steps show no states but the outputs"):
        assert qm.identify(lag_log(0.1, 8), order=3).fit.order == 0


def test_matrices_are_of_numpy_and_can_be_read():
    model = qm.identify(lag_log()).model
    np.testing.assert_allclose(model.A, [[0.9, 0.2], [-0.1, 0.7]], atol=1e-8)
    np.testing.assert_allclose(np.abs(model.poles), np.abs(np.linalg.eigvals(model.A)), atol=1e-9)
