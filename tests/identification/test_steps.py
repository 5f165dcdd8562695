"""Logs of TorchRL's steps."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torchrl.collectors.utils import split_trajectories

from tests.logs import arx_log
from tests.refused import refused
from torch_qpmpc import QPError
from torch_qpmpc.identification.reading import as_log


def steps_of(log: Any) -> list[int]:
    return [part.steps for part in as_log(log).trajectories]


def test_a_log_is_read_in_order():
    log = arx_log()
    found = as_log(log, n_d=1).trajectories
    assert len(found) == 3
    for i, (y, u, d) in enumerate(found):
        assert torch.equal(y[:-1], log["observation"][i])
        assert torch.equal(y[1:], log["next", "observation"][i])
        assert torch.equal(u, log["action"][i])
        assert torch.equal(d, log["preview"][i, :, :1])


def test_trajectories_end_at_flags_ids_and_other_observations():
    log = arx_log()
    log["next", "truncated"] = torch.zeros(3, 40, 1, dtype=torch.bool)
    log["next", "truncated"][0, 9] = True
    log["collector"] = TensorDict({"traj_ids": torch.zeros(3, 40, dtype=torch.int64)}, [3, 40])
    log["collector", "traj_ids"][1, 25:] = 1
    log["observation"][2, 7] += 1
    assert steps_of(log) == [10, 30, 25, 15, 7, 33]


def test_logs_of_different_lengths_are_read():
    log = arx_log()
    parts = [log[0], log[1, :30]]
    assert steps_of(lazy_stack(parts)) == steps_of(parts) == [40, 30]  # pyright: ignore[reportArgumentType] (a list)
    assert steps_of(lazy_stack([log[0], log[1]])) == [40, 40]
    with pytest.raises(
        QPError, match=r"^trajectories: got logs of \(n_x, n_u\) = \(1, 1\), \(2, 1\), "
    ):
        as_log(
            [
                log[0],
                change("observation", lambda x: x[..., :1])(
                    change(("next", "observation"), lambda x: x[..., :1])(log[1])
                ),
            ]
        )


def test_padded_steps_are_left_out():
    log: Any = arx_log(episodes=1)[0]
    log.set("traj_ids", (torch.arange(40) >= 12).long())
    padded = split_trajectories(log, trajectory_key="traj_ids")
    assert padded.shape == (2, 28)
    assert steps_of(padded) == [12, 28]
    padded["action"][0, 20] = torch.nan
    assert steps_of(padded) == [12, 28]


def change(key, value):
    def changed(log: TensorDict) -> TensorDict:
        return log.set(key, value(log.get(key)))

    return changed


def spoilt(index: tuple[int, ...], number: float):
    def changed(value):
        value[index] = number
        return value

    return changed


@refused(
    (lambda log: log.exclude("action"), "trajectories: got only .*, expected an entry action"),
    (
        lambda log: log.exclude(("next", "observation")),
        r"trajectories: got only .*, expected an entry next\.observation. Pass logged steps",
    ),
    (lambda log: log.exclude("preview"), "trajectories: got only .*, expected an entry preview"),
    (lambda log: log[0, 0], r"trajectories: got shape \(\), expected shape \(T,\) or \(epi"),
    (
        change("action", spoilt((1, 5, 0), torch.nan)),
        r"action: got nan at step \(1, 5\), entry 0, expected finite numbers. Cut the steps",
    ),
    (change("observation", spoilt((2, 3, 1), torch.inf)), r"observation: got inf at step \(2, 3\)"),
    (change("action", lambda x: x[..., 0]), r"action: got shape \(3, 40\), expected a real tensor"),
    (
        change("observation", lambda x: x[..., :1]),
        r"next\.observation: got 2 entries, but 1 in observation, expected the same number",
    ),
    (change("preview", lambda x: x[..., :0]), r"preview: got shape \(3, 40, 0\), expected a real"),
    (
        lambda log: log.set(("next", "done"), torch.zeros(3, 40, 2, dtype=torch.bool)),
        r"next\.done: got shape \(3, 40, 2\), expected shape \(3, 40\) or \(3, 40, 1\)",
    ),
    (
        change("observation", lambda x: 1e155 * x),
        r"observation: got .*e\+155, expected numbers up to 1e.100. Squares .* larger units",
    ),
    (
        lambda log: log.set("mask", torch.zeros(3, 40, dtype=torch.bool)),
        "trajectories: got no steps, expected logged steps",
    ),
)
def test_bad_data_are_named(mistake):
    as_log(mistake(arx_log()), n_d=1)
