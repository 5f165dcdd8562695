"""The Kalman filter as a transform, in any TorchRL environment."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    GymEnv,
    GymWrapper,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)

from tests.store import Store
from torch_qpmpc.envs import KalmanFilter, PlantEnv
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.innovations import Innovations

ID, STEPS = "Pendulum-v1", 7


def model(n: int = 4, n_y: int = 3, n_d: int = 0) -> Innovations:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    shapes = {"B": (n, 1), "E": (n, n_d), "offset": (n,), "C": (n_y, n), "L": (n, n_y)}
    parts = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    return Innovations(A, **parts, S=np.eye(n_y), x0=rng.normal(size=n), P0=np.eye(n))


MODEL = model()


def transformed(env: Any, *transforms: Any) -> Any:
    compose: Any = Compose
    return TransformedEnv(env, compose(*transforms))


def pendulum() -> Any:
    return GymEnv(ID)


def observed(key: str = "estimate") -> Any:
    return transformed(pendulum(), StepCounter(STEPS), KalmanFilter(MODEL, estimate_key=key))


def vectorised(count: int = 3) -> Any:
    disabled = {"autoreset_mode": AutoresetMode.DISABLED}
    options: Any = {"vectorization_mode": "sync", "vector_kwargs": disabled}
    envs = gymnasium.make_vec(ID, count, max_episode_steps=STEPS, **options)
    observer = KalmanFilter(MODEL, estimate_key="estimate")
    return transformed(GymWrapper(envs), DoubleToFloat(), observer)


def make_policy(size: int = 4, key: str = "estimate") -> Any:
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(size, 1), torch.nn.Tanh()).requires_grad_(False)
    return TensorDictModule(net, in_keys=[key], out_keys=["action"])


def check_estimates(data: Any) -> None:
    """Compare the estimates ``(envs, T)`` with those of whole trajectories, by NumPy."""
    ends = data["next", "done"].squeeze(-1).clone()
    ends[:, -1] = True
    for row, end in zip(data, ends, strict=True):
        start = 0
        for stop in (end.nonzero().flatten() + 1).tolist():
            part = row[start:stop]
            y = torch.cat((part["observation"], part["next", "observation"][-1:])).double()
            xi = MODEL.estimates(*(x.numpy() for x in (y, part["action"].double(), y[1:, :0])))
            for key, expected in (("estimate", xi[:-1]), (("next", "estimate"), xi[1:])):
                np.testing.assert_allclose(part[key].numpy(), expected, rtol=1e-4, atol=1e-4)
            start = stop


@pytest.mark.parametrize(
    "env",
    [
        observed,
        vectorised,
        partial(SerialEnv, 2, observed),
        lambda: transformed(
            SerialEnv(2, pendulum), StepCounter(STEPS), KalmanFilter(MODEL, estimate_key="estimate")
        ),
    ],
    ids=["one", "vectorised", "inside of a batch", "outside of a batch"],
)
def test_the_estimates_are_those_of_each_episode(env):
    made = env()
    check_env_specs(made, seed=0)
    made.set_seed(0)
    data = made.rollout(20, make_policy(), break_when_any_done=False)
    check_estimates(data if len(data.batch_size) == 2 else data.unsqueeze(0))
    made.close()


@pytest.mark.slow
def test_the_estimates_in_worker_processes():
    env = ParallelEnv(1, observed)
    check_env_specs(env, seed=0)
    check_estimates(env.rollout(20, make_policy(), break_when_any_done=False))
    env.close()
    options = {"frames_per_batch": 6, "total_frames": 60, "auto_register_policy_transforms": False}
    collector = MultiSyncCollector([vectorised], make_policy(), **options)
    batches = [batch.clone() for batch in collector]
    check_estimates(torch.cat([batch.reshape(-1, batch.shape[-1]) for batch in batches], dim=1))
    collector.shutdown()


def test_the_estimates_in_a_collector():
    options = {"frames_per_batch": 6, "total_frames": 60, "auto_register_policy_transforms": False}
    collector = Collector(vectorised(), make_policy(), **options)
    check_estimates(torch.cat([batch.clone() for batch in collector], dim=1))
    collector.shutdown()


def test_the_estimate_takes_the_outputs_place_by_default():
    env = transformed(pendulum(), StepCounter(STEPS), KalmanFilter(MODEL))
    check_env_specs(env, seed=0)
    data, other = (
        made.rollout(STEPS, make_policy(key=key))
        for made, key in ((env, "observation"), (observed(), "estimate"))
        if made.set_seed(0) or True
    )
    assert torch.equal(data["observation"], other["estimate"])


def test_known_signals_move_the_state():
    known, plant = model(3, 2, 2), Store()
    env = TransformedEnv(
        PlantEnv(plant, 2, 7, torch.float64, seed=0), KalmanFilter(known, estimate_key="x")
    )
    data = env.rollout(6)
    for row in data:
        y = torch.cat((row["observation"], row["next", "observation"][-1:]))
        xi = known.estimates(y.numpy(), row["action"].numpy(), row["preview"][:, :2].numpy())
        np.testing.assert_allclose(row["x"].numpy(), xi[:-1], rtol=1e-9, atol=1e-9)


def test_a_missing_output_corrects_nothing():
    observer, x = KalmanFilter(MODEL), torch.ones(2, 4).double()
    y = torch.tensor([[1.0, torch.nan, 0.5], [torch.nan] * 3]).double()
    u, none = torch.zeros(2, 1).double(), x[:, :0]
    after = observer.following(x, u, none, y, 5)
    predicted = x @ observer.A.mT + observer.offset
    assert torch.equal(after[1], predicted[1])
    filled = torch.where(y.isnan(), predicted @ observer.C.mT, y)
    torch.testing.assert_close(after, observer.following(x, u, none, filled, 5))


def test_an_environment_of_other_sizes_is_named():
    with pytest.raises(QPError, match=r"^model: got tuple, expected an Innovations. Of an ident"):
        KalmanFilter(([[0.9]], [[0.5]]))  # pyright: ignore[reportArgumentType] - the mistake
    with pytest.raises(QPError, match=r"observation_key: got s, expected one of observation"):
        _ = transformed(pendulum(), KalmanFilter(MODEL, observation_key="s")).observation_spec
    message = r"the environment: got outputs and actions of sizes \(3, 1\), .*of sizes \(2, 1\)"
    with pytest.raises(QPError, match=message):
        _ = transformed(pendulum(), KalmanFilter(model(4, 2))).observation_spec
    with pytest.raises(QPError, match=r"^y: got shape \(3,\), expected shape \(\*batch, 2\)"):
        transformed(pendulum(), KalmanFilter(model(4, 2))).reset()


class Leaky(gymnasium.Env):
    """A lag whose two sensors answer in some steps only."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.k, self.x = 0, 1.0
        return self.seen(), {}

    def seen(self) -> np.ndarray:
        there = np.array([self.k % 3 == 0, self.k % 5 == 0])
        y = self.x * np.array([1.0, 0.5]) + 0.1 * np.sin([1.7 * self.k, 2.3 * self.k])
        return np.where(there, y, np.nan)

    def step(self, action):
        self.k, self.x = self.k + 1, 0.9 * self.x + 0.2 * float(action[0])
        return self.seen(), 0.0, False, False, {}


def test_the_covariance_is_carried_where_outputs_are_often_missing():
    own = model(3, 2)._replace(S=np.array([[1.0, 0.2], [0.2, 0.5]]))
    own = own._replace(L=0.2 * own.L, P0=0.5 * np.eye(3))
    observer = KalmanFilter(own, missing=True, estimate_key="estimate")
    env = TransformedEnv(GymWrapper(Leaky()), observer)
    check_env_specs(env, seed=0)
    data = env.rollout(25, make_policy(3).double())
    y = torch.cat((data["observation"], data["next", "observation"][-1:])).numpy()
    assert np.isnan(y).mean() > 0.5
    expected = own.estimates(y, data["action"].numpy(), y[1:, :0])
    np.testing.assert_allclose(data["next", "estimate"].numpy(), expected[1:], atol=1e-9)
    steady = KalmanFilter(own, estimate_key="estimate")
    other = TransformedEnv(GymWrapper(Leaky()), steady).rollout(25, make_policy(3).double())
    assert not np.allclose(other["next", "estimate"], expected[1:], atol=1e-2)
