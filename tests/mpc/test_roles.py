"""Outputs of a log that the actions do not move."""

from __future__ import annotations

import pytest
import torch

from torch_qpmpc.mpc.log import Trajectory
from torch_qpmpc.mpc.roles import unmoved

N = 8


def trajectories(follow: float = 0.0, episodes: int = 10, steps: int = 100) -> list[Trajectory]:
    """Return a lag of the held actions, the same rounded, a slow sum, a wave and a set-point.

    The set-point jumps at the same times in all episodes, as the plant moves from its start, and
    moves by ``follow`` times the rounded output.
    """
    draw = torch.Generator().manual_seed(3)
    logs = []
    for _ in range(episodes):
        u = torch.rand(steps // 4, 2, generator=draw, dtype=torch.float64).repeat_interleave(4, 0)
        v = torch.zeros(steps + 1, 2, dtype=torch.float64)
        v[0] = 1.0
        for k in range(steps):
            v[k + 1] = 0.7 * v[k] + 0.3 * u[k]
        y, k = v[:, 0], torch.arange(steps + 1)
        rounded = (4 * v[:, 1]).round()
        r = torch.where(k < 2, 0.0, torch.where(k < 50, 1.0, 0.5)) + follow * rounded
        columns = (y, rounded, (0.01 * y).cumsum(0), (k / 9.0).sin(), r, torch.ones_like(y))
        logs.append(Trajectory(torch.stack(columns, -1), u, u[:, :0]))
    return logs


def test_set_points_and_constants_are_not_moved_but_rounded_and_slow_outputs_are():
    assert unmoved(trajectories(), N) == [4, 5]


def test_an_output_that_follows_the_actions_is_moved():
    assert unmoved(trajectories(follow=0.1), N) == [5]


@pytest.mark.parametrize("steps", [1, N])
def test_a_short_log_is_read_as_far_as_it_goes(steps):
    log = [each.between(0, steps) for each in trajectories()]
    assert 5 in unmoved(log, N)


def lag(u: torch.Tensor) -> Trajectory:
    """Return a rounded lag of the first input and a count of its large values."""
    y = torch.zeros(len(u) + 1, dtype=torch.float64)
    for k in range(len(u)):
        y[k + 1] = 0.9 * y[k] + u[k, 0]
    large = torch.cat((torch.zeros(1), (u[:, 0].abs() > 0.7).double()))
    return Trajectory(torch.stack((y.round(), large), -1), u, u[:, :0])


@pytest.mark.parametrize("kind", ["uniform", "binary", "dead input", "rare", "short"])
def test_what_an_input_moves_is_not_held_whatever_the_excitation(kind):
    draw = torch.Generator().manual_seed(0)
    u = torch.rand(2000, 1, generator=draw).double() * 2 - 1
    u = {
        "uniform": u,
        "binary": 0.8 * u.sign(),
        "dead input": torch.cat((u, 0 * u), -1),
        "rare": u[:80].repeat_interleave(25, 0),
        "short": u[:60],
    }[kind]
    assert unmoved([lag(u)], N) == ([1] if kind == "binary" else [])  # where all are large
