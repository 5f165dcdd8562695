"""Episodes of logs that blow up."""

import pytest
import torch
from tensordict import TensorDict

from torch_qpmpc.experiment.logs import without_blow_ups


def log() -> TensorDict:
    """Return two environments with three episodes of four steps each, all of size one."""
    y, done = torch.ones(2, 13, 2).double(), torch.zeros(2, 12, 1, dtype=torch.bool)
    done[:, 3::4] = True
    following = {"observation": y[:, 1:].clone(), "reward": torch.zeros(2, 12, 1), "done": done}
    steps = {"observation": y[:, :-1].clone(), "action": torch.zeros(2, 12, 1), "next": following}
    return TensorDict(steps, (2, 12))


def test_a_log_of_bounded_episodes_is_returned_as_it_is():
    data = log()
    assert without_blow_ups(data) == (data, 0)
    data["next", "observation"][0, 2] = 1e5
    assert without_blow_ups(data)[0] is data


@pytest.mark.parametrize("value", [1e7, torch.nan, -torch.inf])
def test_the_rest_of_an_episode_is_masked(value):
    data = log()
    data["next", "observation"][0, 5, 1] = data["observation"][0, 6, 1] = value
    data["next", "reward"][1, 11] = torch.nan
    masked, count = without_blow_ups(data)
    kept = torch.ones(2, 12, dtype=torch.bool)
    kept[0, 5:8] = kept[1, 11] = False
    assert count == 2
    assert torch.equal(masked["mask"], kept)
    assert "mask" not in data
    one, count = without_blow_ups(data[0])
    assert (one["mask"].tolist(), count) == (kept[0].tolist(), 1)


def test_from_zero_only_numbers_that_are_not_finite_are_cut():
    data = log()
    data["observation"][:, 0] = data["next", "observation"][:, 0] = 0
    assert without_blow_ups(data)[1] == 0
    data["next", "observation"][0, 1, 0] = torch.nan
    assert without_blow_ups(data)[1] == 1
