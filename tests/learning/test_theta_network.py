"""A QP whose theta a network schedules, as TorchRL modules: ThetaNetwork, theta_keys, losses."""

# TensorDict annotates less than its modules take, and wrong types are the mistakes under test.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportOptionalOperand=false, reportOptionalMemberAccess=false

import copy
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torch.testing import assert_close
from torchrl.objectives import SoftUpdate, TD3Loss

from tests.problems import central_difference, random_mpc
from tests.refused import refused
from tests.transitions import GAMMA, make_loss
from torch_qpmpc import (
    QPMPC,
    GaussNewton,
    QPActorValueOperator,
    QPError,
    QPQLearningLoss,
    ThetaNetwork,
)
from torch_qpmpc.learning.penalties import Penalties
from torch_qpmpc.learning.updates import second_order

SIZES = {"q": 0.3, "b": 0.1, "c": 1.0}


def scheduled(
    known: dict[str, Any] | None = None, moved: bool = True, **keys: Any
) -> tuple[QPMPC, ThetaNetwork, QPActorValueOperator]:
    """Make a QP, the network of its theta, and their operator; ``moved`` shifts the network."""
    torch.manual_seed(0)
    mpc = random_mpc(3, action_slack=5.0, **(known or {}))
    theta = ThetaNetwork(mpc, SIZES, width=8)
    if moved:
        with torch.no_grad():
            theta.net[-1].weight.normal_(std=0.5)
    preview = {"preview_key": "preview"} if mpc.n_d else {}
    return mpc, theta, QPActorValueOperator(mpc, theta_keys=theta.theta_keys, **preview, **keys)


def critic_of(theta: Any, operator: Any) -> TensorDictSequential:
    return TensorDictSequential(theta, operator)


def actor_of(theta: Any, operator: Any, **options: Any) -> TensorDictSequential:
    policy = operator.get_policy_operator(**options)
    return TensorDictSequential(theta, policy, selected_out_keys=["action"])


def transitions(mpc: QPMPC, count: int = 6) -> TensorDictBase:
    generator = torch.Generator().manual_seed(1)

    def known() -> dict[str, Tensor]:
        p = torch.rand(count, mpc.n_p, generator=generator) - 0.5
        n = (mpc.horizon + 1) * mpc.n_d
        return {"observation": p[:, n:]} | ({"preview": p[:, :n]} if n else {})

    flags = {name: torch.zeros(count, 1, dtype=torch.bool) for name in ("done", "terminated")}
    following = TensorDict(known() | flags, [count])
    following["reward"] = -torch.rand(count, 1, generator=generator)
    action = 0.4 * torch.rand(count, mpc.n_u, generator=generator)
    return TensorDict(known() | {"action": action, "next": following}, [count])


def test_a_new_network_leaves_the_mpc_as_it_is():
    mpc, theta, operator = scheduled(moved=False)
    td = transitions(mpc)
    assert theta(td.clone())["theta", "q"].abs().max() == 0
    plain = QPActorValueOperator(mpc)
    pairs = [
        (critic_of(theta, operator), plain, "state_action_value"),
        (actor_of(theta, operator), plain.get_policy_operator(), "action"),
        (
            TensorDictSequential(theta, operator.get_value_operator()),
            plain.get_value_operator(),
            "state_value",
        ),
    ]
    for ours, other, key in pairs:
        assert torch.equal(ours(td.clone())[key], other(td.clone())[key])


@pytest.mark.parametrize("known", [{}, {"n_d": 1}], ids=["state", "preview"])
def test_values_and_policy_are_those_of_the_qp_with_residuals(known):
    mpc, theta, operator = scheduled(known)
    td = transitions(mpc)
    assert theta.in_keys == (["preview", "observation"] if known else ["observation"])
    p = torch.cat([td[key] for key in theta.in_keys], -1)
    residuals = theta(td.clone())["theta"].to_dict()
    assert all(0 < x.abs().max() <= SIZES[name] for name, x in residuals.items())
    assert residuals["q"].shape == (6, mpc.n_z)
    qp = mpc.quadratic_program(residuals)
    assert torch.equal(
        critic_of(theta, operator)(td.clone())["state_action_value"].squeeze(-1),
        -mpc.action_value(p, td["action"], qp),
    )
    assert torch.equal(actor_of(theta, operator)(td.clone())["action"], mpc.policy(p, qp=qp))
    assert not torch.equal(mpc.policy(p, qp=qp), mpc.policy(p))


@pytest.mark.parametrize("output", ["state_value", "state_action_value", "action"])
def test_finite_differences_through_theta_keys(output):
    mpc, theta, operator = scheduled()
    theta.double()
    td = transitions(mpc).double()
    views = {
        "state_value": TensorDictSequential(theta, operator.get_value_operator()),
        "state_action_value": critic_of(theta, operator),
        "action": actor_of(theta, operator),
    }

    def total() -> Tensor:
        return views[output](td.clone())[output].sum()

    total().backward()
    weight: Any = theta.net[-1].weight
    direction = torch.randn_like(weight)
    slope = central_difference(total, weight, direction, 1e-5).item()
    assert (weight.grad * direction).sum().item() == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("known", [{}, {"n_d": 1}], ids=["state", "preview"])
def test_the_loss_is_that_of_the_residuals_by_hand(known):
    mpc, theta, operator = scheduled(known)
    loss = make_loss(operator=critic_of(theta, operator))
    assert ("theta", "q") not in loss.in_keys
    td = transitions(mpc)
    before = set(td.keys(True, True))
    value = TensorDictSequential(theta, operator.get_value_operator())(td["next"].clone())
    target = td["next", "reward"] + GAMMA * value["state_value"]
    prediction = critic_of(theta, operator)(td.clone())["state_action_value"]
    assert_close(loss(td)["loss_value"], 0.5 * (target - prediction).square().mean())
    assert set(td.keys(True, True)) - before == {"td_error"}  # theta is not stored


@pytest.mark.parametrize("part", ["net.4.weight", "module.C"])
def test_target_networks_hold_the_network_and_the_qp_and_move_softly(part):
    mpc, theta, operator = scheduled()
    loss = make_loss(operator=critic_of(theta, operator), delay_value=True)
    update = SoftUpdate(loss, tau=0.25)

    def last(params: Any) -> Tensor:
        found = params.flatten_keys(".").to_dict()
        return next(x for name, x in found.items() if name.endswith(part))

    target, online = loss.target_value_network_params, loss.value_network_params
    start = last(target).clone()
    assert torch.equal(start, last(online))
    with torch.no_grad():
        theta.net[-1].weight.add_(1.0)
        mpc.C.add_(1.0)
    update.step()
    assert_close(last(target), start + 0.25)


def test_the_state_dict_holds_the_network():
    def build(seed: int) -> tuple[ThetaNetwork, QPQLearningLoss]:
        _, theta, operator = scheduled()
        torch.manual_seed(seed)
        with torch.no_grad():
            theta.net[-1].weight.normal_()
        return theta, make_loss(operator=critic_of(theta, operator), delay_value=True)

    (theta, loss), (other, fresh) = build(1), build(2)
    assert not torch.equal(theta.net[-1].weight, other.net[-1].weight)
    fresh.load_state_dict(loss.state_dict())
    assert torch.equal(theta.net[-1].weight, other.net[-1].weight)
    for twin in (copy.deepcopy(theta), pickle.loads(pickle.dumps(theta))):
        assert_close(twin.state_dict(), theta.state_dict())
        assert twin.theta_keys == theta.theta_keys


def test_gauss_newton_takes_no_upstream_modules():
    mpc, theta, operator = scheduled()
    message = "loss_module: got a value network with theta_keys"
    for network in (critic_of(theta, operator), operator):
        loss = QPQLearningLoss(network)
        with pytest.raises(QPError, match=message):
            second_order(mpc, loss, GaussNewton(mpc), Penalties())


@refused(
    (lambda mpc: ThetaNetwork(torch.nn.Linear(1, 1), {"q": 1.0}), "mpc: got Linear"),
    (lambda mpc: ThetaNetwork(mpc, ["q"]), "sizes: got list, expected a Mapping. Map names"),
    (lambda mpc: ThetaNetwork(mpc, {}), "sizes: got {}, expected bounds of some of H, q, c"),
    (lambda mpc: ThetaNetwork(mpc, {"A": 1.0}), "sizes: got 'A', expected names among H, q"),
    (lambda mpc: ThetaNetwork(mpc, {"q": 0.0}), r"sizes\['q'\]: got 0.0, expected a f"),
    (lambda mpc: ThetaNetwork(mpc, {"q": 1.0}, width=0), "width: got 0"),
    (
        lambda mpc: ThetaNetwork(mpc, {"q": 1.0})(TensorDict(observation=torch.ones(3, 5))),
        r"p: got shape \(3, 5\), expected shape \(\*batch, 2\)",
    ),
    (
        lambda mpc: ThetaNetwork(mpc, {"q": 1.0})(transitions(mpc).exclude("observation")),
        "observation: got a TensorDict with .*, expected one with observation. Rename the module's",
    ),
    (
        lambda mpc: QPActorValueOperator(mpc, theta_keys={"w": "w"}),
        "theta_keys: got 'w', expected names among .* Add w to learn",
    ),
    (lambda mpc: QPActorValueOperator(mpc, theta_keys="q"), "theta_keys: got str, expected a Mapp"),
    (
        lambda mpc: QPActorValueOperator(mpc, theta_keys={"q": ("theta", "q")})(transitions(mpc)),
        r"\('theta', 'q'\): got a TensorDict with .*, expected one with \('theta', 'q'\)",
    ),
    (
        lambda mpc: QPQLearningLoss(TensorDictSequential(ThetaNetwork(mpc, {"q": 1.0}))),
        "value_network: got a TensorDictSequential that ends with ThetaNetwork",
    ),
)
def test_mistakes(call):
    call(random_mpc(3))


def test_an_actor_and_critics_of_torchrl():
    mpc, theta, operator = scheduled(moved=False)
    _, *of_critic = scheduled()
    critic, td, actor = critic_of(*of_critic), transitions(mpc), actor_of(theta, operator)
    twins = [critic, copy.deepcopy(critic)]
    loss: Any = TD3Loss(actor, twins, bounds=(torch.tensor([-0.5]), torch.tensor([0.5])))
    loss.make_value_estimator(gamma=0.9)
    sum(x for name, x in loss(td).items() if name.startswith("loss")).backward()
    for params, part in ((loss.actor_network_params, "net.4"), (loss.qvalue_network_params, "C")):
        leaves = params.flatten_keys(".").to_dict()
        grads = [x.grad for name, x in leaves.items() if part in name and x.requires_grad]
        assert grads
        assert all(grad.abs().max() > 0 for grad in grads)
    assert "theta" not in td
    SoftUpdate(loss, tau=0.1).step()
