"""The houses' schemes have the plants' own cost, and their tasks' costs are the known ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.runs import make_config
from torch_qpmpc.envs import House, HouseWall
from torch_qpmpc.envs.heated_house import DT
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.evaluation import Evaluation, rival_costs
from torch_qpmpc.experiment.heating import REGULARISATION, known_model
from torch_qpmpc.experiment.rivals.heating import house_mpc
from torch_qpmpc.experiment.tasks import make_mpc as make_task_mpc
from torch_qpmpc.experiment.tasks import make_physics, make_true_mpc
from torch_qpmpc.experiment.tasks.house_wall import best_lags


@pytest.mark.parametrize("air", [11.0, 19.0, 21.5])
def test_the_value_is_the_cost_of_the_plan_in_a_house_without_gain(air):
    house = House(evening_gain=0.0, gain_std=0.0)
    w = house.signals(np.random.default_rng(0), 3, 96)
    mpc = house_mpc(house, known_model(house))
    # Around 6 h the horizon has the end of the night and a peak.
    w, x = w[:, 24 : 24 + 33], torch.full((3, 1), air, dtype=torch.float64)
    p = torch.cat((w[..., :4].flatten(1), x), -1)
    solution = mpc.solve(p)
    outputs, plan = mpc.predicted(solution.z)
    cost = REGULARISATION * plan.square().sum((1, 2))
    for k in range(32):
        torch.testing.assert_close(outputs[:, k], x)
        cost = cost + house.cost(x, plan[:, k], w[:, k])
        x = house.step(x, plan[:, k], w[:, k])
    torch.testing.assert_close(solution.value, cost + DT * house.violation(x, w[:, 32]))


def test_a_margin_moves_the_lower_bound_only():
    house = House()
    tight = house_mpc(house, known_model(house), margin=0.5).quadratic_program()
    loose = house_mpc(house, known_model(house)).quadratic_program()
    rise = (tight.lb - loose.lb).nan_to_num()
    assert rise.unique().tolist() == [0.0, 0.5]
    assert (rise > 0).sum() == 33
    assert torch.equal(tight.ub, loose.ub)


def test_the_room_costs_what_it_is_known_to_cost():
    """The wrong scheme is the planner's, with the discount of learning."""
    cfg = make_config("task=house")
    house = make_physics(cfg)
    start, true = make_task_mpc(cfg, house), make_true_mpc(cfg, house)
    assert true is not None
    J_start, J_true = (evaluate(cfg, mpc.policy, house).J for mpc in (start, true))
    assert (round(J_start, 1), round(J_true, 1)) == (24.0, 21.4)
    assert start.n_z == 197


def test_the_house_with_a_wall_costs_what_it_is_known_to_cost():
    cfg = make_config("task=house_wall", "task.eval_steps=96")
    house = make_physics(cfg)
    start, true = make_task_mpc(cfg, house), make_true_mpc(cfg, house)
    assert true is not None
    assert start.n_p == 33 * 5 + 7 * 2 + 1
    J_start, J_true = (evaluate(cfg, mpc.policy, house).J for mpc in (start, true))
    assert (round(J_start, 1), round(J_true, 1)) == (5.9, 5.0)


def test_q_is_learned_for_the_forecasts_only():
    cfg = make_config("task=house", "task.horizon=4")
    mpc = make_task_mpc(cfg, make_physics(cfg))
    assert mpc.learned == ("q", "c", "C")
    with torch.no_grad():
        for parameter in mpc.parameters():
            parameter.add_(1.0)
    learned = mpc.quadratic_program().q != 0
    assert learned.tolist() == [True] * 20 + [False] * 9


def test_lags_predict_as_the_house_with_a_wall_goes_on():
    """Without gain and with constant weather, the best lags predict the air exactly."""
    house = HouseWall(evening_gain=0.0, gain_std=0.0)
    model = best_lags(HouseWall())
    w = house.signals(np.random.default_rng(0), 4, 2)[:, :1].expand(-1, 12, -1)
    rng = np.random.default_rng(1)
    x = house.starts(rng, 4)
    y, u = [x[:, 0]], []
    for k in range(12):
        u.append(torch.as_tensor(5 * rng.random(4)))
        x = house.step(x, u[-1].unsqueeze(-1), w[:, k])
        y.append(x[:, 0])
    y, u = torch.stack(y, -1), torch.stack(u, -1)
    predicted = y[:, 4:12].flip(-1) @ model.A[0] + u[:, 4:12].flip(-1) @ model.B[0]
    predicted += w[:, 11, :5] @ model.E[0]
    torch.testing.assert_close(predicted, y[:, 12], rtol=0, atol=2e-2)


def test_the_rivals_of_the_room_are_in_order():
    """leap-c's tuning improves its planner, and knowledge is worth more."""
    names = ["omniscient", "tuned planner", "planner (R = 2)", "thermostat"]
    cfg = make_config("task=house", f"rivals=[{','.join(map(repr, names))}]", "eval_seed=5")
    house = make_physics(cfg)
    costs = rival_costs(cfg, house)
    true = make_true_mpc(cfg, house)
    assert true is not None
    J = evaluate(cfg, true.policy, house).J
    assert costs["omniscient"] < J < costs["tuned planner"]
    assert list(costs.values()) == sorted(costs.values())


def test_a_window_changes_neither_the_schemes_of_the_room_nor_its_rivals():
    J = []
    for past in (1, 3):
        more = ("task.horizon=8", "task.eval_steps=48", f"task.past={past}")
        cfg = make_config("task=house", *more)
        house = make_physics(cfg)
        found = Evaluation.before(cfg, house, make_task_mpc(cfg, house))
        assert found.loops["start"].known.shape[-1] == 9 * 4 + 2 * past - 1
        J.append([loop.J for loop in found.loops.values()] + list(found.rivals.values()))
    assert len(J[0]) == 9
    assert J[0] == pytest.approx(J[1])
