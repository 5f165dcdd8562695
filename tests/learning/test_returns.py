"""Returns of several steps, against loops over one environment's steps."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch.testing import assert_close

from tests.problems import normal, random_mpc, random_states
from torch_qpmpc import GaussNewton, QPActorValueOperator, QPError, QPQLearningLoss
from torch_qpmpc.learning.replay import ACTIVE_SET, Replay, make_replay
from torch_qpmpc.learning.returns import STEPS, n_step_transitions
from torch_qpmpc.learning.updates import second_order

ENVS, ROWS, LENGTH, GAMMA = 3, 20, 33, 0.9
#: Steps after which an episode is terminated, truncated, and left by its worker, by environment.
TERMINATED, TRUNCATED, LEFT = ({0: 18, 1: 25}, {0: 26, 2: 30}, {1: 29})


def history() -> TensorDict:
    """Make the ``(ENVS, LENGTH)`` steps of all environments, with one NaN reward."""
    done = torch.zeros(ENVS, LENGTH, 1, dtype=torch.bool)
    terminated, ids = done.clone(), torch.zeros(ENVS, LENGTH, dtype=torch.int64)
    for ends, flags in ((TERMINATED, (done, terminated)), (TRUNCATED, (done,)), (LEFT, ())):
        for env, step in ends.items():
            ids[env, step + 1 :] += 1
            for flag in flags:
                flag[env, step] = True
    reward = normal(ENVS, LENGTH, 1, seed=1)
    reward[2, 20] = torch.nan
    following = TensorDict(
        observation=random_states(ENVS * LENGTH, seed=2).view(ENVS, LENGTH, 2),
        reward=reward,
        done=done,
        terminated=terminated,
        truncated=done & ~terminated,
        batch_size=(ENVS, LENGTH),
    )
    return TensorDict(
        observation=random_states(ENVS * LENGTH, seed=3).view(ENVS, LENGTH, 2),
        action=random_states(ENVS * LENGTH, 1, size=0.5, seed=4).view(ENVS, LENGTH, 1),
        collector=TensorDict(traj_ids=ids + 10 * torch.arange(ENVS)[:, None]),
        next=following,
        batch_size=(ENVS, LENGTH),
    )


def filled(**options: Any) -> Replay:
    """Make a replay that holds the last `ROWS` steps of the history, over the ring's seam."""
    replay = make_replay(ROWS * ENVS, ENVS, 40, 2, 5, **options)
    steps = history()
    for start in range(0, LENGTH, 3):
        replay.extend(steps[:, start : start + 3])
    return replay


def place(index: torch.Tensor) -> tuple[int, int]:
    """Return environment and step of a row and column of the full storage."""
    row, env = index.tolist()
    return env, row + ROWS if row < LENGTH - ROWS else row


def run_of(env: int, step: int, n: int) -> list[int]:
    """List the steps from ``step`` on, at most n, of one episode."""
    ends = {x[env] for x in (TERMINATED, TRUNCATED, LEFT) if env in x} | {LENGTH - 1}
    last = min(end for end in ends if end >= step)
    return list(range(step, min(step + n - 1, last) + 1))


@pytest.mark.parametrize("n_step", [2, 5, 50])
def test_n_step_transitions_end_with_the_episode_and_the_data(n_step):
    replay, steps = filled(n_step=n_step, gamma=GAMMA), history()
    seen = set()
    samples: Any = torch.cat([replay.sample() for _ in range(10)])
    for sample in samples.unbind(0):
        env, step = place(sample["index"])
        run = run_of(env, step, n_step)
        seen.add((env, step))
        expected = sum(GAMMA**i * steps["next", "reward"][env, k] for i, k in enumerate(run))
        assert_close(sample["next", "reward"], expected, equal_nan=True)
        assert sample[STEPS] == len(run)
        assert place(sample["next", "index"]) == (env, run[-1])
        assert torch.equal(sample["action"], steps["action"][env, step])
        for key in ("observation", "terminated", "truncated"):
            assert torch.equal(sample["next", key], steps["next", key][env, run[-1]]), key
    assert len(seen) == ROWS * ENVS


def make_loss(key: str | None = None, **options: Any) -> QPQLearningLoss:
    mpc = random_mpc(3, on_failure="mask")
    loss = QPQLearningLoss(QPActorValueOperator(mpc, active_set_key=key), **options)
    loss.make_value_estimator(gamma=GAMMA)
    return loss


def costs_to_go(loss: QPQLearningLoss) -> torch.Tensor:
    """Return gamma (1 - terminated) V(s+) of the whole history."""
    after: Any = history()["next"]
    V = loss.operator.module.value(after["observation"]).detach()
    return V.masked_fill(after["terminated"].squeeze(-1), 0)


def test_the_loss_discounts_v_by_the_steps():
    loss, steps = make_loss(), history()
    V = costs_to_go(loss)
    sample = filled(n_step=4, gamma=GAMMA).sample()
    assert sample["next", "reward"].isnan().any()
    with pytest.warns(RuntimeWarning, match="rewards are NaN or infinite"):
        target = -loss.target(sample)
    for found, index in zip(target, sample["index"], strict=True):
        env, step = place(index)
        run = run_of(env, step, 4)
        cost = -sum(GAMMA**i * steps["next", "reward"][env, k].item() for i, k in enumerate(run))
        expected = found.new_tensor(cost + GAMMA ** len(run) * V[env, run[-1]].item())
        assert_close(found, expected, equal_nan=True, rtol=1e-6, atol=1e-6)


def test_slices_have_lambda_returns():
    lmbda, n = 0.7, 5
    loss, steps = make_loss(), history()
    loss.make_value_estimator("tdlambda", gamma=GAMMA, lmbda=lmbda)
    V = costs_to_go(loss)
    steps["next", "reward"][2, 20] = 0.5
    replay = make_replay(ROWS * ENVS, ENVS, 200, 2, 5, n_step=n, gamma=None)
    replay.extend(steps)
    slices = replay.sample()
    assert slices.shape == (40, n)
    target = -loss.target(slices)
    for i in range(40):
        for j in range(n):
            env, step = place(slices["index"][i, j])
            run = run_of(env, step, n - j)
            expected = math.nan
            for k in reversed(run):  # L + gamma ((1 - lambda) V + lambda G)
                after = V[env, k].item()
                ahead = after if k == run[-1] else (1 - lmbda) * after + lmbda * expected
                expected = -steps["next", "reward"][env, k].item() + GAMMA * ahead
            assert target[i, j].item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("gamma", [GAMMA, None])
def test_active_sets_are_remembered_where_they_belong(gamma):
    """Those of V(s+) with the step that ends in s+, through a second-order update."""
    loss = make_loss(ACTIVE_SET)
    mpc = loss.operator.module
    if gamma is None:
        loss.make_value_estimator("tdlambda", gamma=GAMMA, lmbda=0.7)
    replay = filled(n_step=4, gamma=gamma, active_rows=len(mpc.G))
    replay.transitions.storage[:]["next", "reward"].nan_to_num_()
    sample = replay.sample()
    before = copy.deepcopy(mpc)
    second_order(mpc, loss, GaussNewton(mpc), None, None)(sample, None)
    replay.remember(sample)
    stored: TensorDictBase = replay.transitions.storage[:]
    rows, columns = sample["index"].reshape(-1, 2).unbind(-1)
    visited: Any = stored[rows, columns]
    expected = before.solve(visited["observation"], visited["action"]).active
    assert torch.equal(visited[ACTIVE_SET], expected)
    rows, columns = sample["next", "index"].reshape(-1, 2).unbind(-1)
    after: Any = stored.get("next")[rows, columns]
    assert torch.equal(after[ACTIVE_SET], before.solve(after["observation"]).active)


def test_a_second_order_step_on_slices_is_the_one_on_their_pairs():
    loss = make_loss()
    loss.make_value_estimator("tdlambda", gamma=GAMMA, lmbda=0.7)
    mpc = loss.operator.module
    slices = filled(n_step=4, gamma=None).sample()
    slices["next", "reward"].nan_to_num_()
    twin, target = copy.deepcopy(mpc), loss.target(slices).reshape(-1)
    pairs = slices.reshape(-1)
    GaussNewton(twin).step(pairs["observation"], pairs["action"], -target)
    second_order(mpc, loss, GaussNewton(mpc), None, None)(slices, None)
    assert_close(mpc.state_dict(), twin.state_dict())


def test_ended_episodes_do_not_continue_in_those_of_a_new_collector():
    replay = filled(n_step=3, gamma=GAMMA)
    for _ in range(2):
        ids = replay.transitions.storage[:]["collector", "traj_ids"].clone()
        replay.end_episodes()
        after = replay.transitions.storage[:]["collector", "traj_ids"]
        assert (after < 0).all()
        assert torch.equal(after.diff(dim=0), ids.diff(dim=0))
    make_replay(6, 3, 4, 2, 1).end_episodes()  # nothing stored


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_step": 0}, "n_step: got 0, expected a whole number"),
        ({"gamma": 1.5}, r"gamma: got 1.5, expected a number in \[0, 1\]"),
        ({"n_step": 3, "gamma": None}, "batch_size: got 40, expected a multiple of n_step = 3"),
    ],
)
def test_bad_arguments_of_the_replay(options, message):
    with pytest.raises(QPError, match=message):
        filled(**options)


def test_bad_arguments_of_n_step_transitions():
    with pytest.raises(QPError, match=r"slices: got shape \(3,\), expected \(M, n\)"):
        n_step_transitions(history()[:, 0], GAMMA)
    with pytest.raises(QPError, match=r"gamma: got -1, expected a number in \[0, 1\]"):
        n_step_transitions(history(), -1)
