"""Gymnasium environments as plants: requirements, and episodes."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, Tuple

from tests.refused import refused
from torch_qpmpc.envs import GymnasiumPlant
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.errors import QPError


class Counter(gymnasium.Env):
    """An environment whose state counts the steps and which terminates at ``last``."""

    def __init__(self, observations=None, actions=None, last: int = 1000) -> None:
        self.observation_space = observations or Box(0.0, 1000.0, (1,), np.float32)
        self.action_space = actions or Box(-1.0, 2.0, (1,), np.float32)
        self.last, self.k = last, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.k = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.k, self.action = self.k + 1, action
        return np.full(1, self.k, np.float32), -float(self.k), self.k >= self.last, False, {}


def test_the_bounds_are_those_of_its_spaces():
    plant = GymnasiumPlant("Pendulum-v1")
    assert plant.ub_s.tolist() == [1, 1, 8]
    assert plant.lb_s.tolist() == [-1, -1, -8]
    assert (plant.lb_a.tolist(), plant.ub_a.tolist()) == ([-2], [2])
    assert plant.lb_s.dtype == plant.lb_a.dtype == torch.float64


@pytest.mark.filterwarnings("ignore:.*out of date")
@refused(
    *(
        (id, {}, f"task.id: got '{id}', expected an environment that Gymnasium can make")
        for id in ("Pendulum-v9", "NoSuchThing-v0", "no such thing", "Ant-v2")
    ),
    (
        "Pendulum-v1",
        {"weight": 2},
        "task.kwargs: got {'weight': 2}, expected arguments .* 'weight'",
    ),
)
def test_an_unknown_environment_or_argument_is_an_error(id, options):
    GymnasiumPlant(id, **options)


IMAGES = Box(0, 255, (8, 8, 3), np.uint8)


@refused(
    (
        {"actions": Discrete(2)},
        r".*action space is Discrete\(2\), .* with real vectors as observat",
    ),
    ({"observations": Discrete(5)}, r".* whose observation space is Discrete\(5\), expected"),
    ({"observations": IMAGES}, r".*observation space is Box\(0, 255, \(8, 8, 3\), uint8\), expect"),
    ({"actions": Box(-1, 1, (2, 2))}, ".* whose action space is .* Box spaces of one dimension"),
    *(
        ({kind: Box(0, 9, (1,), getattr(np, dtype))}, f".* {kind} are {dtype}, .* Convert .* Tran")
        for kind in ("actions", "observations")
        for dtype in ("int64", "uint8")
    ),
)
def test_other_spaces_are_an_error(options, register):
    GymnasiumPlant(register(Counter, **options))


def test_further_arguments_are_those_of_its_environment():
    def angles(g: float) -> torch.Tensor:
        plant = GymnasiumPlant("Pendulum-v1", g=g)
        env: Any = plant.make(max_steps=7)
        assert (env.unwrapped.g, env.spec.max_episode_steps) == (g, 7)
        envs = plant.vectorised(2, 3, seed=0)
        batch = envs.rollout(2)
        envs.close()
        return batch["next", "observation"]

    assert not torch.equal(angles(0.0), angles(10.0))


def test_episodes_have_the_environments_own_length(register):
    assert GymnasiumPlant("Pendulum-v1").max_steps == 200
    assert GymnasiumPlant("MountainCarContinuous-v0").max_steps == 999
    assert GymnasiumPlant(register(Counter)).max_steps == 200, "no limit of its own"
    limited = lambda: gymnasium.wrappers.TimeLimit(Counter(), 4)  # noqa: E731 (an entry point)
    plant = GymnasiumPlant(register(limited, name="Limited-v0"))
    assert plant.max_steps == 4, "that of a wrapper"
    env = plant.vectorised(1, None, seed=0)
    assert env.rollout(9)["next", "done"].flatten().tolist() == [False] * 3 + [True]
    env.close()
    assert len(closed_loop(lambda s: s[:, :1], plant, starts=2).costs) == 4


@pytest.mark.parametrize(
    ("most", "dtype"),
    [(1e-9, np.float64), (2.0, np.float32), (1e6, np.float64), (np.inf, np.float64)],
)
def test_actions_in_any_unit_are_clipped_and_a_solvers_rounding_is_zero(register, most, dtype):
    env = GymnasiumPlant(register(Counter, actions=Box(-most, most, (1,), dtype))).make()
    own: Any = env.unwrapped
    env.reset(seed=0)
    size, shares = (most, (0.7, -1e-6, 3.0, -3.0, 1e-10))
    if most == np.inf:
        size, shares = 1e-12, (0.7, -1e-6)
    for share in shares:
        env.step(np.array([share * size], dtype))
        applied = size * (0.0 if share == 1e-10 else np.clip(share, -1, 1))
        assert own.action.item() == pytest.approx(applied, rel=1e-6, abs=0)
        assert own.action.dtype == dtype


@pytest.mark.parametrize("kind", [Dict, Tuple])
def test_parts_of_an_observation_become_one_vector(register, kind):
    class Parts(gymnasium.ObservationWrapper):
        def __init__(self, **_) -> None:
            super().__init__(Counter())
            level, age = Box(0.0, 9.0, (2,), np.float32), Box(-1.0, 1.0, (1,), np.float32)
            named, plain = Dict(level=level, age=age), Tuple((level, age))
            self.observation_space = named if kind is Dict else plain

        def observation(self, observation) -> Any:
            level, age = observation * np.array([1, 2], np.float32), np.full(1, -0.5, np.float32)
            return {"age": age, "level": level} if kind is Dict else (level, age)

    plant = GymnasiumPlant(register(Parts))
    assert plant.ub_s.tolist() == [9, 9, 1]
    env = plant.vectorised(2, 3, seed=0)
    batch = env.rollout(2)
    env.close()
    assert batch["next", "observation"][0].tolist() == [[1, 2, -0.5], [2, 4, -0.5]]
    run = closed_loop(lambda s: torch.zeros(len(s), 1), plant, steps=2, starts=2)
    assert run.states[-1, 0].tolist() == [2, 4, -0.5]


@pytest.mark.parametrize(("last", "flag"), [(1000, "truncated"), (3, "terminated")])
def test_an_episode_keeps_its_last_observation_and_its_flag(register, last, flag):
    env = GymnasiumPlant(register(Counter, last=last)).vectorised(2, 3 + (last == 3), seed=0)
    batch = env.rollout(7, break_when_any_done=False)
    env.close()
    assert batch.shape == (2, 7)
    before, after = batch["observation"][..., 0], batch["next", "observation"][..., 0]
    assert before.tolist() == [[0, 1, 2, 0, 1, 2, 0]] * 2
    assert after.tolist() == [[1, 2, 3, 1, 2, 3, 1]] * 2
    ends = [[False, False, True, False, False, True, False]] * 2
    assert batch["next", flag].squeeze(-1).tolist() == ends
    assert batch["next", "done"].squeeze(-1).tolist() == ends
    other = "terminated" if flag == "truncated" else "truncated"
    assert not batch["next", other].any()
    assert batch["next", "reward"].squeeze(-1)[0].tolist() == [-1, -2, -3, -1, -2, -3, -1]


@pytest.mark.filterwarnings("ignore:.*The reward returned by", "ignore:The plant ends an episode")
@pytest.mark.parametrize("count", [1, 2])
def test_a_reward_in_an_array_is_one_number_or_ends_the_episode(register, count):
    class Rewarded(Counter):
        def step(self, action):
            y, reward, *rest = super().step(action)
            return y, np.full(count, reward), *rest

    plant = GymnasiumPlant(register(Rewarded))
    env = plant.vectorised(2, 3, seed=0)
    rewards = env.rollout(3)["next", "reward"][..., 0]
    env.close()
    assert rewards.nan_to_num(9.0).tolist() == [[-1, -2, -3] if count == 1 else [9]] * 2
    assert len(plant.raised) == 2 * (count - 1)


@pytest.mark.filterwarnings("ignore:.*The obs returned by")
@pytest.mark.parametrize("step", [0, 2])
def test_an_observation_of_another_shape_than_its_space_is_an_error(register, step):
    class Wide(Counter):
        def reset(self, *, seed=None, options=None):
            y, info = super().reset(seed=seed)
            return (y if step else y.repeat(3)), info

        def step(self, action):
            y, *rest = super().step(action)
            return (y.repeat(3) if self.k == step else y), *rest

    plant = GymnasiumPlant(register(Wide))
    match = r"task.id: got an observation of shape \(3,\), expected \(1,\), as in its space"
    with pytest.raises(QPError, match=match):
        closed_loop(lambda s: torch.zeros(len(s), 1), plant, steps=3, starts=2)
    with pytest.raises(QPError, match=match):
        plant.vectorised(2, 3, seed=0).rollout(3)
    assert not plant.raised


class Fragile(Counter):
    """Raises in step ``at`` of each episode whose seed, or number, is odd."""

    def __init__(self, at: int = 2, error: type[Exception] = FloatingPointError) -> None:
        super().__init__(last=4)
        self.at, self.error, self.episode = at, error, -1

    def reset(self, *, seed=None, options=None):
        self.episode = self.episode + 1 if seed is None else seed
        return super().reset(seed=seed)

    def step(self, action):
        if self.k + 1 == self.at and self.episode % 2:
            raise self.error("the integrator failed")
        return super().step(action)


@pytest.mark.filterwarnings("ignore:The plant ends an episode")
@pytest.mark.parametrize("at", [1, 2, 4])
def test_an_exception_ends_its_episode_alone(register, at):
    plant = GymnasiumPlant(register(Fragile), at=at)
    loop = closed_loop(lambda s: torch.zeros(len(s), 1), plant, steps=5, starts=4, seed=0)
    assert loop.raised.tolist() == [False, True] * 2
    assert len(plant.raised) == 2
    assert plant.raised[0].startswith("FloatingPointError: the integrator failed (")
    assert plant.raised[0].split("(")[1].startswith(f"{__file__}, line ")
    assert pytest.approx(10) == loop.J
    assert loop.discounted(0.9) < 10
    env = plant.vectorised(2, 5, seed=0)
    batch = env.rollout(12, break_when_any_done=False)
    env.close()
    bad = batch["next", "reward"].isnan()
    assert bad.any()
    assert batch["next", "done"][bad].all()
    assert batch["next", "observation"].isfinite().all()
    assert len(plant.raised) > 2


def test_a_wrong_use_of_an_environment_is_no_fault_of_the_plant(register):
    plant = GymnasiumPlant(register(Fragile))
    with pytest.raises(gymnasium.error.ResetNeeded):
        plant.make().step(np.zeros(1, np.float32))
    with pytest.warns(UserWarning, match="The plant ends an episode by FloatingPointError: the in"):
        closed_loop(lambda s: torch.zeros(len(s), 1), plant, steps=5, starts=4, seed=0)


def test_one_seed_is_one_set_of_different_episodes():
    plant = GymnasiumPlant("Pendulum-v1")

    def starts(seed: int) -> torch.Tensor:
        env = plant.vectorised(3, 5, seed=seed)
        s = env.reset()["observation"]
        env.close()
        return s

    assert torch.equal(starts(1), starts(1))
    assert not torch.equal(starts(1), starts(2))
    assert len(starts(1).unique(dim=0)) == 3
