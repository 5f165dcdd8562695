"""The QP in TorchRL's losses: as critic, actor, mean and state value, and in ensembles."""

from __future__ import annotations

import copy
import io
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.objectives import HardUpdate, SoftUpdate

from tests.losses import (
    ENSEMBLES,
    LOSSES,
    ON_POLICY,
    make_batch,
    make_loss,
    total,
)

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
OFF_POLICY = [name for name in LOSSES if name not in ON_POLICY]
UPDATERS: dict[str, Any] = {
    "soft": lambda loss: SoftUpdate(loss, tau=0.25),
    "hard": lambda loss: HardUpdate(loss, value_network_update_interval=1),
}


def learned(loss: Any) -> dict[str, Tensor]:
    """What a loss learns; of an actor all but c, on which no action depends."""
    return {
        name: parameter
        for name, parameter in loss.named_parameters()
        if parameter.requires_grad and not (name.startswith("actor") and name.endswith(".c"))
    }


def targets(loss: Any) -> dict[str, Tensor]:
    return {name: x.clone() for name, x in loss.named_buffers() if name.startswith("target_")}


def train(name: str, steps: int = 3) -> Any:
    loss = make_loss(name)
    batch = make_batch(loss)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for step in range(steps):
        optimizer.zero_grad()
        total(loss, batch, seed=step).backward()
        optimizer.step()
    return loss


@pytest.mark.parametrize("name", LOSSES)
def test_gradients_reach_all_that_is_learned(name):
    loss = make_loss(name)
    total(loss, make_batch(loss)).backward()
    assert any(".module.C" in key for key in learned(loss)) or "DQN" in name
    for key, parameter in learned(loss).items():
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all(), key
        assert parameter.grad.norm() > 0, key


@pytest.mark.parametrize("name", LOSSES)
def test_training_moves_theta_and_can_be_repeated(name):
    start, once, again = make_loss(name), train(name), train(name)
    assert total(once, make_batch(once)).isfinite()
    for key, parameter in learned(once).items():
        assert parameter.isfinite().all(), key
        assert not torch.equal(parameter, start.get_parameter(key)), key
        assert torch.equal(parameter, again.get_parameter(key)), key


@pytest.mark.parametrize("updater", UPDATERS)
@pytest.mark.parametrize("name", OFF_POLICY)
def test_targets_are_frozen_until_they_are_updated(name, updater):
    loss = make_loss(name)
    # A DQN has its target, and an SAC v1 that of its value, only if asked: all here have one.
    start = targets(loss)
    assert start
    update = UPDATERS[updater](loss)
    optimizer = torch.optim.SGD(loss.parameters(), lr=1e-4)
    total(loss, make_batch(loss)).backward()
    optimizer.step()
    for key, target in targets(loss).items():
        assert torch.equal(target, start[key]), key
    for _ in range(2 if updater == "hard" else 1):
        update.step()
    share, moved = (1.0 if updater == "hard" else 0.25), 0
    online = dict(loss.named_parameters())
    for key, target in targets(loss).items():
        source = online.get(key.removeprefix("target_"))
        if source is None:  # a constant, such as the bounds
            assert torch.equal(target, start[key]), key
            continue
        expected = start[key] + share * (source.detach() - start[key])
        torch.testing.assert_close(target, expected, msg=key)
        moved += not torch.equal(target, start[key])
    assert moved


@pytest.mark.parametrize("estimator", ["td0", "td1", "tdlambda"])
@pytest.mark.parametrize("name", LOSSES)
def test_estimators(name, estimator):
    loss = make_loss(name, estimator)
    total(loss, make_batch(loss)).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in learned(loss).values())


def differ(one: Any, other: Any) -> bool:
    batch = make_batch(one)
    return not torch.equal(total(one, batch), total(other, batch))


@pytest.mark.parametrize("name", LOSSES)
def test_state_dict_round_trip(name):
    trained, fresh = train(name, 1), make_loss(name, seed=1)
    with torch.no_grad():
        total(fresh, make_batch(trained))  # what TorchRL registers at the first call
    file = io.BytesIO()
    torch.save(trained.state_dict(), file)
    file.seek(0)
    assert differ(trained, fresh)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    assert not differ(trained, fresh)


@pytest.mark.parametrize("name", LOSSES)
def test_deepcopy_is_independent(name):
    loss = make_loss(name)
    twin = copy.deepcopy(loss)
    assert not differ(loss, twin)
    with torch.no_grad():
        for parameter in learned(loss).values():
            parameter += 0.01
    assert differ(loss, twin)


@pytest.mark.parametrize("name", LOSSES)
def test_pickle(name):
    """TorchRL's ensembles hold a local function, which cannot be pickled; the others can."""
    loss = make_loss(name)
    if name in ENSEMBLES:
        with pytest.raises((AttributeError, pickle.PicklingError), match="local object"):
            pickle.dumps(loss)
    else:
        assert not differ(loss, pickle.loads(pickle.dumps(loss)))
