"""Windows that never cross episodes, at any position of the ring, and reproducible sampling."""

import io

import pytest
import torch
from tensordict import TensorDictBase

from tests import store
from tests.rollouts import Staggered, collected
from torch_qpmpc.envs import LinearSystemEnv, PointMass
from torch_qpmpc.errors import QPError
from torch_qpmpc.learning.replay import Replay, walk, windows_to_tau

ENVS, N = 8, 4


class StaggeredEnv(Staggered, LinearSystemEnv):
    """A plant whose episodes start, and therefore end, at different steps."""


def batches(count: int, steps: int, max_steps: int) -> list[TensorDictBase]:
    """Noiseless ``(ENVS, steps)`` batches, so that the physics can be checked."""
    env = StaggeredEnv(PointMass(noise_std=0.0), ENVS, max_steps=max_steps, seed=0)
    return [*collected(env, count, steps).split(steps, dim=1)]


def filled(data: list[TensorDictBase], rows: int, num_windows: int = 400, seed: int = 0) -> Replay:
    replay = Replay(rows * ENVS, ENVS, 32, N, num_windows, seed=seed)
    for batch in data:
        replay.extend(batch)
    return replay


def check_windows(replay: Replay) -> torch.Tensor:
    """Check that windows are consecutive steps of one episode; return row indices ``(M, N)``."""
    sample, info = replay.windows.sample(return_info=True)
    sample = sample.reshape(-1, N)
    first = sample[:, :1]
    ids, counts = sample["collector", "traj_ids"], sample["step_count"].squeeze(-1)
    assert (ids == first["collector", "traj_ids"]).all()
    assert (counts - counts[:, :1] == torch.arange(N)).all()
    assert not sample["next", "done"][:, :-1].any()

    tau, physics = windows_to_tau(sample).double(), PointMass(noise_std=0.0)
    states = torch.cat([tau[:, :-4].unflatten(1, (N, 6))[..., :4], tau[:, None, -4:]], dim=1)
    actions = tau[:, :-4].unflatten(1, (N, 6))[..., 4:]
    following = physics.step(states[:, :-1], actions, torch.zeros(4))
    torch.testing.assert_close(states[:, 1:], following, atol=1e-6, rtol=0)
    return info["index"][0].reshape(-1, N)


@pytest.mark.parametrize(
    ("steps", "max_steps", "rows"), [(1, 7, 40), (2, N, 15), (3, 50, 15), (3, 7, 40)]
)
def test_windows_never_cross_episodes(steps, max_steps, rows):
    replay = Replay(rows * ENVS, ENVS, 32, N, 200)
    wrapped = False
    for batch in batches(60 // steps, steps, max_steps):
        replay.extend(batch)
        if replay.windows.can_sample():
            index = check_windows(replay)
            wrapped |= bool((index.diff(dim=1) < 0).any())
    assert len(replay) == rows * ENVS
    assert wrapped, "some window lay over the ring's end"


def test_every_window_is_found():
    """In 7-step episodes every start 0..3 occurs, including the episode's end."""
    replay = filled(batches(40, 2, max_steps=7), rows=40, num_windows=2000)
    sample = replay.windows.sample().reshape(-1, N)
    assert sample["step_count"][:, 0].unique().tolist() == [0, 1, 2, 3]
    assert sample["next", "done"][:, -1].any()


def test_sampling_leaves_the_stored_flags_alone():
    replay = filled(batches(30, 2, max_steps=7), rows=40)
    before = replay.transitions.storage[:].clone()
    sample = replay.windows.sample().reshape(-1, N)
    replay.sample()
    assert (replay.transitions.storage[:] == before).all()
    assert torch.equal(sample["next", "done"], sample["next", "step_count"] == 7)
    assert torch.equal(sample["next", "truncated"], sample["next", "done"])
    assert not sample["next", "terminated"].any()
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        replay.windows.extend(sample)


def test_stored_transitions_are_sampled_uniformly():
    data = batches(30, 2, max_steps=50)
    replay = filled(data, rows=10)
    assert replay.sample().shape == (32,)
    stored = torch.cat([batch["observation"] for batch in data], dim=1)[:, -10:].flatten(0, 1)
    draws = torch.cat([replay.sample()["observation"] for _ in range(250)])
    hits = (draws[:, None] == stored).all(-1)
    assert hits.any(1).all(), "only the newest 10 rows are there"
    assert hits.sum(0).min() > 60, "each of 80 is expected 100 times in 8000"
    assert hits.sum(0).max() < 145


def test_tau_begins_with_all_that_is_known():
    """Each window is p_j, as seen at step j, then the actions and measured outputs after it."""
    data = store.collect(4, 30, dtype=torch.float32)
    done = data["next", "done"].squeeze(-1)
    data["collector", "traj_ids"] = done.cumsum(1) - done.long() + 100 * torch.arange(4)[:, None]
    replay = Replay(4 * 30, 4, 8, 3, 50, preview_key="preview")
    replay.extend(data)
    tau = replay.sample_tau()
    assert tau.shape == (50, store.make_mpc().n_z)

    def windows(i: int, k: int) -> torch.Tensor:
        p = [data["preview"][i, k], data["observation"][i, k]]
        a, y = data["action"][i, k : k + 3], data["next", "observation"][i, k : k + 3]
        return torch.cat([*p, torch.cat((a, y), -1).flatten()])

    inside = [(i, k) for i in range(4) for k in range(28) if not done[i, k : k + 2].any()]
    possible = torch.stack([windows(i, k) for i, k in inside])
    assert (tau[:, None] == possible).all(-1).any(1).all()


def test_sampling_depends_on_the_seed_alone():
    data = batches(20, 2, max_steps=50)

    def draws(seed):
        torch.seed()  # torch's global generator has no effect
        replay = filled(data, rows=40, num_windows=5, seed=seed)
        return torch.cat([replay.sample()["action"].flatten(), replay.sample_tau().flatten()])

    assert torch.equal(draws(1), draws(1))
    assert not torch.equal(draws(1), draws(2))
    assert filled(data, rows=40, num_windows=5).sample_tau().shape == (5, N * 6 + 4)


@pytest.mark.parametrize("count", [5, 33])
def test_a_restored_replay_equals_an_undisturbed_one(count):
    """Episodes exceed the ring, so that both sides of its seam have one trajectory id."""
    data = batches(count + 10, 2, max_steps=500)
    first = filled(data[:count], rows=15)
    first.sample()
    first.sample_tau()
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = filled([], rows=15, seed=99)
    second.load_state_dict(torch.load(file, weights_only=True))
    assert len(second) == len(first) == min(15, 2 * count) * ENVS
    check_windows(second)
    check_windows(first)
    for batch in data[count:]:
        assert torch.equal(first.sample_tau(), second.sample_tau())
        assert (first.sample() == second.sample()).all()
        first.extend(batch)
        second.extend(batch)


@pytest.mark.parametrize("capacity", [33, 24, 0])
def test_bad_capacity_is_an_error(capacity):
    with pytest.raises(QPError, match=rf"capacity: got {capacity}, .* The smallest is 32\."):
        Replay(capacity, ENVS, 32, N, 5)


def noisy(kind: str, seed: int, max_steps: int = 30, count: int = 40) -> TensorDictBase:
    """Return random steps of ``ENVS`` episodes in turn, with an exactly known constant state."""
    env = LinearSystemEnv(PointMass(noise_kind=kind), ENVS, max_steps=max_steps, seed=seed)
    torch.manual_seed(seed)
    steps = env.rollout(count, break_when_any_done=False)
    for key in ("observation", ("next", "observation")):
        steps[key] = torch.nn.functional.pad(steps[key], (0, 1), value=3.0)
    return steps


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_random_walk_is_told_from_white_noise_in_any_unit(seed, unit):
    for kind, walks in (("brownian", True), ("gaussian", False)):
        steps = noisy(kind, seed)
        for key in ("observation", ("next", "observation")):
            steps[key] = steps[key].double() * torch.tensor([unit, 1, 1, 1 / unit, 1]).double()
        size = walk(steps)  # a walk of 30 steps; a fifth state has none
        assert size == pytest.approx(15 ** (0.5 * 4 / 5), rel=0.4) if walks else size == 0


def test_steps_without_noise_or_neighbours_are_no_walk():
    assert not walk(noisy("brownian", 0)[:, :1])
    assert not walk(noisy("brownian", 0)[:1, :8])
    exact = LinearSystemEnv(PointMass(noise_std=0.0), ENVS, max_steps=30, seed=0)
    assert not walk(exact.rollout(40, break_when_any_done=False))


def test_windows_of_a_random_walk_are_pairs_whose_errors_differ_by_its_steps():
    data, physics = noisy("brownian", 1), PointMass(noise_kind="brownian")
    ids = (torch.arange(40) // 30 + 2 * torch.arange(ENVS)[:, None]).expand(ENVS, 40)
    for key in ("observation", ("next", "observation")):
        data[key] = data[key][..., :4]
    data["collector", "traj_ids"] = ids
    tau, size = filled([data], rows=40).sample_tau().double(), walk(data)
    assert size > 2
    assert tau.shape == (400, 2, N * 6 + 4)
    s, a, after = tau[..., :4], tau[..., 4:6], tau[..., 6:10]
    steps = (after - s @ physics.A.T - a @ physics.B.T).diff(dim=1)
    assert steps.std().item() == pytest.approx(0.002 * size, rel=0.1)
    torch.testing.assert_close(tau[:, 0, 6:], tau[:, 1, :-6])
