"""Closed loops against a plain reference implementation."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.envs.test_gymnasium_plant import Counter
from tests.envs.test_kalman_filter import model
from tests.store import Store
from torch_qpmpc.envs import GymnasiumPlant, PointMass
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.errors import QPError

K = torch.tensor([[1.5, 0.0, 1.0, 0.0], [0.0, 1.5, 0.0, 1.0]], dtype=torch.float64)


def in_numpy(kind: str, std: float, steps: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Compute states and costs of the policy -K s in NumPy."""
    rng = np.random.default_rng(123)
    s = np.hstack([rng.uniform(-1.5, 1.5, (32, 2)), rng.uniform(-0.5, 0.5, (32, 2))])
    A = np.eye(4) + 0.1 * np.eye(4, k=2) - 0.1 * np.diag([0, 0, 1, 1])
    B, bound = 0.1 * np.eye(4, 2, k=-2), np.array([2, 2, 10, 10])
    nu, states, costs = np.zeros((32, 4)), [s], []
    for _ in range(steps):
        a = np.clip(-s @ K.numpy().T, -1, 1)
        costs.append((s**2) @ [3, 3, 0.25, 0.25])
        step = std * rng.normal(size=(32, 4))
        nu = nu + step if kind == "brownian" else step
        s = np.clip(s @ A.T + a @ B.T + nu, -bound, bound)
        states.append(s)
    return np.array(states), np.array(costs)


@pytest.mark.parametrize(("kind", "std"), [("gaussian", 0.01), ("brownian", 0.002)])
def test_closed_loop_follows_the_protocol(kind, std):
    run = closed_loop(lambda s: -s @ K.T, PointMass(kind))
    states, costs = in_numpy(kind, std)
    np.testing.assert_allclose(run.states.numpy(), states, atol=1e-12)
    np.testing.assert_allclose(run.costs.numpy(), costs, atol=1e-12)
    assert run.states.shape == (51, 32, 4)
    assert run.actions.shape == (50, 32, 2)
    assert run.actions.abs().max() == 1, "as applied: clipped"
    assert pytest.approx(costs.sum(0).mean()) == run.J
    discounted = (0.9 ** np.arange(50)[:, None] * costs).sum(0).mean()
    assert pytest.approx(discounted) == run.discounted(0.9)


@pytest.mark.parametrize("observer", [None, model(3, 2, 2)], ids=["outputs", "estimates"])
def test_the_seed_determines_signals_and_starts_of_a_plant(observer):
    class Rival:
        begun: Any = None

        def begin(self, plant: Store, x: Tensor, w: Tensor) -> None:
            self.begun = (plant, x, w)

        def __call__(self, p: Tensor) -> Tensor:
            assert p.shape == (3, 8 + (3 if observer else 2))
            return torch.full((3, 1), 2.0).double()

    plant, rival = Store(observer=observer), Rival()
    run = closed_loop(rival, plant, steps=5, starts=3, seed=7)
    rng = np.random.default_rng(7)
    w = plant.signals(rng, 3, 5 + 3 + 1)
    x = plant.starts(rng, 3)
    assert rival.begun[0] is plant
    assert torch.equal(rival.begun[1], x)
    assert torch.equal(rival.begun[2], w)
    one = torch.ones(3, 1).double()
    assert torch.equal(run.actions, one.expand(5, 3, 1)), "as applied: clipped"
    y = []
    for k in range(5):
        y.append(plant.output(x, w[:, k]))
        assert torch.equal(run.known[k, :, :8], w[:, k : k + 4, :2].flatten(1))
        assert torch.equal(run.costs[k], plant.cost(x, one, w[:, k]))
        x = plant.step(x, one, w[:, k])
    y = torch.stack((*y, plant.output(x, w[:, 5])))
    for i in range(3):
        u, d = run.actions[:, i].numpy(), w[i, :5, :2].numpy()
        seen = observer.estimates(y[:, i].numpy(), u, d) if observer else y[:, i]
        assert_close(run.states[:, i], torch.as_tensor(seen), rtol=1e-9, atol=1e-9)


def test_policy_gets_float64_and_leaves_no_graph():
    seen = []
    net = torch.nn.Linear(4, 2)

    def policy(s):
        seen.append((s.dtype, s.shape, torch.is_grad_enabled()))
        return net(s.float())

    run = closed_loop(policy, PointMass(), steps=2, starts=3)
    assert seen == [(torch.float64, (3, 4), False)] * 2
    assert run.actions.dtype == torch.float64
    assert not run.costs.requires_grad


@pytest.mark.parametrize("shape", [(32,), (2,), (1, 2), (32, 1)])
def test_policy_of_another_shape_is_an_error(shape):
    match = rf"policy\(s\): got shape \({shape[0]},.*\), expected shape \(32, 2\)"
    with pytest.raises(QPError, match=match):
        closed_loop(lambda s: torch.zeros(shape), PointMass())


PENDULUM = GymnasiumPlant("Pendulum-v1")


def swing(s):
    return 4 * s[:, 2:]


def test_a_loop_in_gymnasium_is_one_episode_of_each_start():
    run = closed_loop(swing, PENDULUM, steps=30, starts=3, seed=7)
    assert run.states.shape == (31, 3, 3)
    assert run.actions.shape == (30, 3, 1)
    for i in range(3):
        env = gymnasium.make("Pendulum-v1")
        s, _ = env.reset(seed=7 + i)
        for k in range(30):
            np.testing.assert_allclose(run.states[k, i], s, rtol=1e-6)
            a = np.clip(4 * s[2:], -2, 2)
            np.testing.assert_allclose(run.actions[k, i], a, rtol=1e-6)
            s, reward, *_ = env.step(a)
            assert run.costs[k, i] == pytest.approx(-float(reward), rel=1e-6)
        env.close()
    other = closed_loop(swing, PENDULUM, steps=30, starts=2, seed=8)
    assert torch.equal(run.costs[:, 1:], other.costs), "start i is of the seed seed + i"
    assert run.actions.abs().max() == 2, "as applied: clipped"
    assert (0.9 ** np.arange(30) @ run.costs.numpy()).mean() == pytest.approx(run.discounted(0.9))


@pytest.mark.parametrize(("steps", "reached"), [(6, [0, 1, 2, 3, 3, 3, 3]), (2, [0, 1, 2])])
def test_after_a_termination_nothing_costs_and_nothing_moves(register, steps, reached):
    plant, asked = GymnasiumPlant(register(Counter, last=3)), []
    policy = lambda s: asked.append(s) or 0 * s  # noqa: E731
    run = closed_loop(policy, plant, steps=steps, starts=2)
    assert run.states[..., 0].T.tolist() == [reached] * 2
    assert run.costs[:, 0].tolist() == [1, 2, 3, 0, 0, 0][:steps]
    assert run.lengths.tolist() == [min(steps, 3)] * 2
    assert len(asked) == min(steps, 3), "until the last one ends"
