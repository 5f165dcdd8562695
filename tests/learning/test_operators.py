"""The QP as TorchRL modules: signs, shapes, shared parameters, and use in losses."""

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from tests.store import collect
from tests.store import make_mpc as make_store_mpc
from tests.transitions import make_operator
from torch_qpmpc import QPMPC, QPActorValueOperator, QPError, SolveLog, SolverError
from torch_qpmpc.envs import PointMass
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.learning.operators import POLICY_ACTIVE_SET, warm_policy
from torch_qpmpc.qp.program import UNKNOWN
from torch_qpmpc.qp.solvers import BACKENDS

BATCHES = [(), (3,), (2, 3)]


def make_mpc() -> QPMPC:
    return make_operator().module


def make_inputs(*batch: int, dtype: torch.dtype = torch.float64) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    s = 2 * torch.rand(*batch, 2, generator=generator) - 1
    a = 2 * torch.rand(*batch, 1, generator=generator) - 1
    return TensorDict(observation=s.to(dtype), action=a.to(dtype), batch_size=batch)


@torch.no_grad()
def change(mpc: QPMPC) -> None:
    """Change the QP in place; scaling rows of C would not change it."""
    mpc.C *= torch.linspace(0.5, 1.5, mpc.n_z)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_are_minus_the_costs_to_go(batch, dtype):
    mpc = make_mpc()
    operator, td = QPActorValueOperator(mpc), make_inputs(*batch, dtype=dtype)
    V, Q = mpc.value(td["observation"]), mpc.action_value(td["observation"], td["action"])
    assert (V > 0).all(), "the sign is seen"
    critic, value = operator.get_critic_operator(), operator.get_value_operator()
    assert torch.equal(critic(td)["state_action_value"], -Q.unsqueeze(-1))
    assert torch.equal(value(td)["state_value"], -V.unsqueeze(-1))
    assert td["state_value"].shape == td["state_action_value"].shape == (*batch, 1)
    assert td["state_value"].dtype == td["state_action_value"].dtype == dtype
    assert (td["state_action_value"] < td["state_value"]).all(), "V is the best of Q"

    state = td.select("observation")
    best = operator.get_policy_operator()(state)["action"]
    assert torch.equal(best, mpc.policy(td["observation"]))
    assert best.shape == (*batch, 1)
    assert best.dtype == dtype
    tolerance = 1e-5 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(
        critic(state)["state_action_value"], td["state_value"], rtol=tolerance, atol=tolerance
    )


def test_a_preview_is_an_input_of_its_own():
    mpc, td = make_store_mpc(), collect(3, 4)
    operator = QPActorValueOperator(mpc, preview_key="preview")
    value, policy = operator.get_value_operator(), operator.get_policy_operator()
    assert operator.in_keys == ["observation", "action", "preview"]
    assert value.in_keys == policy.in_keys == ["observation", "preview"]
    p = torch.cat((td["preview"], td["observation"]), -1)
    assert torch.equal(operator.known(td), p)
    assert p.shape == (3, 4, mpc.n_p)
    y, a, d = td["observation"], td["action"], td["preview"]
    assert torch.equal(operator(y, a, d), -mpc.action_value(p, a).unsqueeze(-1))
    assert torch.equal(value(td)["state_value"], -mpc.value(p).unsqueeze(-1))
    assert torch.equal(policy(td)["action"], mpc.policy(p))

    whole = QPActorValueOperator(mpc)  # whose observation is p
    assert torch.equal(whole(p, a), operator(y, a, d))
    with pytest.raises(QPError, match=r"^preview: got .*, expected one with preview\."):
        operator(td.exclude("preview", ("next", "preview")))
    with pytest.raises(QPError, match=r"s: got shape \(3, 4, 2\), expected shape \(\*batch, 10\)"):
        whole(td)


def evaluate(operator: QPActorValueOperator, td: TensorDict) -> list[torch.Tensor]:
    views = (operator, operator.get_value_operator(), operator.get_policy_operator())
    # The policy runs last because it writes the action.
    data = td.clone()
    return [view(data)[view.out_keys[0]].detach().clone() for view in views]


def test_one_set_of_parameters_drives_every_view():
    """As for a target network, through `to_module`, for Q, V and the policy."""
    mpc, td = make_mpc(), make_inputs(4)
    operator, other = QPActorValueOperator(mpc), QPActorValueOperator(copy.deepcopy(mpc))
    change(other.module)
    params: Any = TensorDict.from_module(other, as_module=True)
    expected, before = evaluate(other, td), evaluate(operator, td)
    views = (operator, operator.get_value_operator(), operator.get_policy_operator())
    for view, x, y in zip(views, expected, before, strict=True):
        with params.to_module(view):
            assert torch.equal(view(td.clone())[view.out_keys[0]], x)
        assert torch.equal(view(td.clone())[view.out_keys[0]], y), "put back afterwards"
        assert not torch.equal(x, y)


# --- Policies with warm starts in closed loop ----------------------------------------------------


def make_corridor(solver: str, **options: Any) -> QPMPC:
    """Make a QP of the point mass in which many rows are active at first."""
    plant = PointMass()
    options = {"state_bounds": (plant.lb_s, plant.ub_s), "horizon": 8, "solver": solver} | options
    bounds, weight = (plant.lb_a, plant.ub_a), torch.tensor([6, 6, 0.5, 0.5, 0.1, 0.1])
    return QPMPC.from_model(plant.A, plant.B, action_bounds=bounds, stage_weight=weight, **options)


@pytest.mark.parametrize("solver", BACKENDS)
def test_warm_actions_are_the_cold_ones(solver):
    """Compared on the states of one closed loop, from the most violated, and in separate loops."""
    mpc = make_corridor(solver)
    policy = QPActorValueOperator(mpc).get_policy_operator(POLICY_ACTIVE_SET)
    cold = closed_loop(mpc.policy, PointMass(), steps=20, starts=8)
    td, recalled = TensorDict(), []
    for s in cold.states:
        with SolveLog() as log:
            policy(td.set("observation", s))
        torch.testing.assert_close(td["action"], mpc.policy(s), rtol=0, atol=1e-8)
        assert torch.equal(td[POLICY_ACTIVE_SET], mpc.solve(s).active)
        recalled.append(log.recalled)
    assert sum(recalled) > 0.9 * 8 * len(recalled), "few steps need the solver"
    warm = closed_loop(warm_policy(mpc), PointMass(), steps=20, starts=8)
    torch.testing.assert_close(warm.actions, cold.actions, rtol=0, atol=1e-7)


def test_unsolved_steps_leave_no_active_set():
    mpc = make_corridor("daqp", state_slack=torch.inf, on_failure="mask")
    inside = torch.tensor([0.1, 0.1, 0.0, 0.0])
    far = 3 * PointMass().ub_s.float()
    policy, td = QPActorValueOperator(mpc).get_policy_operator("codes"), TensorDict()
    policy(td.set("observation", torch.stack((inside, far))))
    assert (td["codes"] == UNKNOWN).all(-1).tolist() == [False, True]
    policy(td.set("observation", torch.stack((inside, inside))))
    torch.testing.assert_close(td["action"][1], mpc.policy(inside))
    mpc.on_failure = "raise"
    with pytest.raises(SolverError, match="1 of 2"):
        policy(td.set("observation", torch.stack((inside, far))))


def test_warm_policies_under_vmap_and_compiled():
    mpc, td = make_mpc(), make_inputs(4)
    s, active = td["observation"], mpc.solve(td["observation"].flip(0)).active
    expected = mpc.policy(s)

    def act(s: torch.Tensor, active: torch.Tensor) -> torch.Tensor:
        policy: Any = QPActorValueOperator(mpc).get_policy_operator("codes")
        return policy(TensorDict(observation=s, codes=active))["action"]

    torch.testing.assert_close(torch.vmap(act)(s, active), expected)
    warm = torch.compile(mpc.policy, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(warm(s, active), expected)


def test_a_gradient_passes_through_a_warm_policy():
    mpc, s = make_mpc(), make_inputs(4)["observation"]
    start = mpc.solve(s.flip(0)).active
    warm, cold = (
        torch.autograd.grad(mpc.policy(s, warm_start=start).square().sum(), mpc.C)
        for start in (start, None)
    )
    torch.testing.assert_close(warm, cold)
