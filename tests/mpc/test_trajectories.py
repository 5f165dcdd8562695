from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torch.testing import assert_close
from torchrl.collectors.utils import split_trajectories

from tests.logs import arx_log
from torch_qpmpc import QPError
from torch_qpmpc.mpc.trajectories import folds, read_trajectories


def lengths(log: TensorDict) -> list[int]:
    return [trajectory.steps for trajectory in read_trajectories(log)]


def test_a_log_is_read_in_order():
    log = arx_log()
    found = read_trajectories(log, n_d=1)
    assert len(found) == 3
    for i, (y, u, d) in enumerate(found):
        assert torch.equal(y[:-1], log["observation"][i])
        assert torch.equal(y[1:], log["next", "observation"][i])
        assert torch.equal(u, log["action"][i])
        assert torch.equal(d, log["preview"][i, :, :1])


def test_steps_of_one_trajectory_need_no_dimension_of_episodes():
    assert lengths(arx_log()[0]) == [40]


def test_the_last_entries_of_a_window_are_the_output():
    log = arx_log()
    wide = log.clone()
    for key in ("observation", ("next", "observation")):
        wide[key] = torch.cat((torch.randn(3, 40, 5), log[key]), dim=-1)
    for plain, windowed in zip(read_trajectories(log), read_trajectories(wide, n_x=2), strict=True):
        assert torch.equal(plain.y, windowed.y)


def test_trajectories_end_at_flags_ids_and_gaps():
    log = arx_log()
    log["next", "truncated"] = torch.zeros(3, 40, 1, dtype=torch.bool)
    log["next", "truncated"][0, 9] = True
    log["collector"] = TensorDict({"traj_ids": torch.zeros(3, 40, dtype=torch.int64)}, [3, 40])
    log["collector", "traj_ids"][1, 25:] = 1
    log["observation"][2, 7] += 1
    assert lengths(log) == [10, 30, 25, 15, 7, 33]


def test_a_step_across_a_gap_in_time_is_left_out():
    """The observations do not show it: the next one is the first after the gap."""
    log, index = arx_log(), torch.arange(40)
    time = 60.0 * index

    def of(key: str, times: torch.Tensor) -> list[int]:
        return lengths(log.clone().set(key, times.unsqueeze(-1).expand(3, 40, 1)))

    assert of("time", time) == [40] * 3
    assert of("time", time + torch.rand(40)) == [40] * 3, "jitter"
    assert of("time", 1.7e9 + 0.1 * index.double()) == [40] * 3
    assert of("time", torch.where(index >= 25, time + 3600, time)) == [24, 15] * 3
    assert of("time", 1.7e9 + (index + 100 * (index >= 25)).double()) == [24, 15] * 3
    assert of("time", torch.where(index >= 10, time - 600, time)) == [9, 30] * 3
    assert of("step_count", index + (index >= 30).long()) == [29, 10] * 3
    log["next", "done"][:, 24] = True
    assert of("step_count", index % 25) == [25, 15] * 3, "an end is no gap"


def test_logs_of_different_lengths_are_read():
    log = arx_log()
    parts = [log[0], log[1, :30]]
    assert lengths(lazy_stack(parts)) == lengths(parts) == [40, 30]  # pyright: ignore[reportArgumentType] (a list)
    assert lengths(lazy_stack([log[0], log[1]])) == [40, 40]
    with pytest.raises(
        QPError, match=r"^trajectories: got logs of \(n_x, n_u\) = \(1, 1\), \(2, 1\), "
    ):
        read_trajectories(
            [
                log[0],
                change("observation", lambda x: x[..., :1])(
                    change(("next", "observation"), lambda x: x[..., :1])(log[1])
                ),
            ]
        )
    with pytest.raises(QPError, match=r"^trajectories: got no logs, expected"):
        read_trajectories([])


def test_padded_steps_are_left_out():
    log: Any = arx_log(episodes=1)[0]
    log.set("traj_ids", (torch.arange(40) >= 12).long())
    padded = split_trajectories(log, trajectory_key="traj_ids")
    assert padded.shape == (2, 28)
    assert lengths(padded) == [12, 28]
    padded["action"][0, 20] = torch.nan
    assert lengths(padded) == [12, 28]


def test_steps_sampled_at_random_are_trajectories_of_one_step():
    log = arx_log().reshape(-1)
    assert lengths(log[torch.arange(119, 69, -1)]) == [1] * 50


def test_folds_hold_each_step_once():
    data = read_trajectories(arx_log(), n_d=1)
    parts = folds(data, 7)
    sizes = [sum(trajectory.steps for trajectory in part) for part in parts]
    assert sum(sizes) == 120
    assert max(sizes) - min(sizes) <= 1
    actions = [trajectory.u for part in parts for trajectory in part]
    assert_close(torch.cat(actions), torch.cat([trajectory.u for trajectory in data]))
    assert all(len(t.y) == t.steps + 1 for part in parts for t in part)


def change(key, value):
    def changed(log: TensorDict) -> TensorDict:
        return log.set(key, value(log.get(key)))

    return changed


def spoilt(index: tuple[int, ...], number: float):
    def changed(value):
        value[index] = number
        return value

    return changed


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (lambda log: log.to_dict(), "trajectories: got dict, expected a TensorDictBase. Pass log"),
        (lambda log: log.exclude("action"), "trajectories: got only .*, expected an entry action"),
        (
            lambda log: log.exclude(("next", "observation")),
            r"trajectories: got only .*, expected an entry next\.observation. Pass logged steps",
        ),
        (
            lambda log: log.exclude("preview"),
            "trajectories: got only .*, expected an entry preview",
        ),
        (lambda log: log[0, 0], r"trajectories: got shape \(\), expected shape \(T,\) or \(epi"),
        (
            change("action", spoilt((1, 5, 0), torch.nan)),
            r"action: got nan at step \(1, 5\), entry 0, expected finite numbers. Cut the steps",
        ),
        (
            change("observation", spoilt((2, 3, 1), torch.inf)),
            r"observation: got inf at step \(2, 3\), entry 1, expected finite numbers",
        ),
        (
            change("action", lambda x: x[..., 0]),
            r"action: got shape \(3, 40\), expected a real tensor \(3, 40, 'n'\)",
        ),
        (
            change("observation", lambda x: x[..., :1]),
            r"next\.observation: got 2 entries, but 1 in observation, expected the same number",
        ),
        (
            change("preview", lambda x: x[..., :0]),
            r"preview: got shape \(3, 40, 0\), expected a real tensor \(3, 40, 'n'\) with n >= 1",
        ),
        (
            lambda log: log.set(("next", "done"), torch.zeros(3, 40, 2, dtype=torch.bool)),
            r"next\.done: got shape \(3, 40, 2\), expected shape \(3, 40\) or \(3, 40, 1\)",
        ),
        (
            lambda log: log.to("meta"),
            "observation: got a meta tensor, expected a tensor with values",
        ),
        (
            change("observation", lambda x: 1e155 * x),
            r"observation: got .*e\+155, expected numbers up to 1e.100. Squares .* larger units",
        ),
        (
            lambda log: log.set("mask", torch.zeros(3, 40, dtype=torch.bool)),
            "trajectories: got no steps, expected logged steps",
        ),
    ],
)
def test_bad_data_are_named(mistake, message):
    with pytest.raises(QPError, match=f"^{message}"):
        read_trajectories(mistake(arx_log()), n_d=1)
