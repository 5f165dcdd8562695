"""After an error inside a loss, its networks have their own tensors and still work."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close
from torchrl.objectives import LossModule

from tests import losses
from tests.learners import make, settings
from tests.transitions import TRACE, make_batch, make_loss, make_operator
from torch_qpmpc import QPMPC, QPError, SolverError
from torch_qpmpc.learning.restoring import restored


class SolveFailedError(Exception):
    """An error in a solve."""


def fail(*_: object, **__: object) -> None:
    raise SolveFailedError


def networks(loss: LossModule) -> dict[str, nn.Module]:
    return {name: x for name, x in vars(loss).items() if isinstance(x, nn.Module)}


def contents(loss: LossModule) -> dict[str, tuple[list[str], list[int], dict[str, Tensor]]]:
    """Return names and identities of the networks' parameters, and copies of their states."""
    found = {}
    for name, network in networks(loss).items():
        named = dict(network.named_parameters())
        state = {key: x.detach().clone() for key, x in network.state_dict().items()}
        found[name] = list(named), [id(x) for x in named.values()], state
    return found


def assert_same(found: dict, before: dict) -> None:
    assert found.keys() == before.keys()
    for name, (names, ids, state) in before.items():
        assert found[name][:2] == (names, ids), name
        assert list(found[name][2]) == list(state), name
        assert_close(found[name][2], state, rtol=0, atol=0)


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("delay_value", [False, True])
@pytest.mark.parametrize("estimator", TRACE)
@pytest.mark.parametrize("where", ["observation", ("next", "observation"), "infeasible", "solve"])
def test_the_q_learning_loss_after_an_error(where, estimator, delay_value, monkeypatch):
    operator = make_operator(on_failure="raise", state_slack=torch.inf)
    loss = make_loss(estimator, operator, delay_value=delay_value)
    good = make_batch(2, 3)
    for part in (good, good["next"]):
        part["observation"] *= 0.3  # pyright: ignore[reportIndexIssue, reportArgumentType]
    good["action"] *= 0.3
    good["next", "terminated"][:] = False
    expected, before = loss(good.clone()), contents(loss)
    gradient = torch.autograd.grad(expected["loss_value"], operator.module.C)[0]
    bad, error = good.clone(), QPError
    if where == "infeasible":
        bad["next", "observation"][0, 1], error = 5.0, SolverError
    elif where != "solve":
        bad[where][0, 1] = torch.nan
    with monkeypatch.context() as patch:
        if where == "solve":
            error = SolveFailedError
            patch.setattr(QPMPC, "value", fail)  # V(s+), while Q(s, a) is solved
        with pytest.raises(error):
            loss(bad.clone())
        if where != "observation":
            with pytest.raises(error):
                loss.target(bad.clone())
    assert before["value_network"][0]
    assert_same(contents(loss), before)
    assert {id(x) for x in operator.module.parameters()} == set(before["value_network"][1])
    out = loss(good.clone())
    assert_close(out.to_dict(), expected.to_dict(), rtol=0, atol=0)
    again = torch.autograd.grad(out["loss_value"], operator.module.C)[0]
    assert_close(again, gradient, rtol=0, atol=0)


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("name", losses.LOSSES)
def test_the_losses_of_torchrl_after_an_error(name, monkeypatch):
    loss = losses.make_loss(name)
    batch = losses.make_batch(loss)
    expected, before = losses.total(loss, batch), contents(loss)
    with monkeypatch.context() as patch:
        for method in ("value", "action_value", "policy"):
            patch.setattr(QPMPC, method, fail)
        with pytest.raises(SolveFailedError), restored(loss):
            loss(batch.copy())
    assert_same(contents(loss), before)
    assert_close(losses.total(loss, batch), expected, rtol=0, atol=0)


@pytest.mark.parametrize(("algo", "critic"), [("ddpg", "mlp"), ("td3", "qp")])
@pytest.mark.parametrize("where", ["observation", ("next", "observation")])
def test_an_update_of_actor_and_critic_after_an_error(where, algo, critic):
    learner, mpc, batch = make(*settings(algo, "qp", critic))
    twin, _, _ = make(*settings(algo, "qp", critic))
    before, parameters = contents(learner.loss_module), list(mpc.parameters())
    bad = batch.clone()
    bad[where][1] = torch.nan
    mpc.on_failure = "raise"
    with pytest.raises(QPError, match="NaN or inf in the data"):
        learner.learn(bad, None)
    assert len(parameters) == 3
    assert [id(x) for x in mpc.parameters()] == [id(x) for x in parameters]
    assert_same(contents(learner.loss_module), before)
    for one in (learner, twin):
        torch.manual_seed(1)
        one.learn(batch.clone(), None)
    assert_close(learner.loss_module.state_dict(), twin.loss_module.state_dict(), rtol=0, atol=0)
