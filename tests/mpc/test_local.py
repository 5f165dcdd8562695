from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch.testing import assert_close

from torch_qpmpc.mpc.identification import identify
from torch_qpmpc.mpc.local import PER_MODEL, local_steps, without


def near_first(log: TensorDict, n_x: int, held=()) -> tuple[Any, list[int]]:
    near = local_steps(log, n_x, held)
    assert near is not None
    return near


def falling(episodes: int, steps: int = 8) -> TensorDict:
    """Log a pendulum that falls from the upright: its angle's sine and cosine, and its rate."""
    generator = torch.Generator().manual_seed(0)
    angle = 0.1 * torch.randn(episodes, generator=generator, dtype=torch.float64)
    rate, logged = torch.zeros_like(angle), []
    u = torch.randn(episodes, steps, 1, generator=generator, dtype=torch.float64)
    for k in range(steps + 1):
        logged.append(torch.stack((angle.sin(), angle.cos(), rate), -1))
        if k < steps:
            rate = rate + 0.5 * angle.sin() + 0.3 * u[:, k, 0]
            angle = angle + 0.5 * rate
    y = torch.stack(logged, 1)
    size = [episodes, steps]
    following = {"observation": y[:, 1:], "done": torch.zeros(*size, 1, dtype=torch.bool)}
    following["done"][:, -1] = True
    return TensorDict({"observation": y[:, :-1], "action": u, "next": following}, size)


def test_the_steps_are_the_nearest_to_the_first_outputs():
    log = falling(60)
    near, still = near_first(log, 3)
    assert near.shape == (PER_MODEL * 5, 1)
    y: Any = near["observation"].flatten(0, 1)
    all_y: Any = log["observation"].flatten(0, 1)
    size, first = all_y.std(0, correction=0), all_y.reshape(60, 8, 3)[:, 0].mean(0)
    distance = ((all_y - first) / size).square().sum(-1)
    limit = distance.sort().values[len(near) - 1]
    assert_close(y, all_y[distance <= limit])
    assert still == [1], "the cosine"


def test_constant_and_held_outputs_are_not_among_those_still():
    log, fixed = falling(60), torch.full((60, 8, 4), 5.0).double()
    for key in ("observation", ("next", "observation")):
        log[key] = torch.cat((log[key], fixed), -1)
    assert near_first(log, 7)[1] == [1]
    assert near_first(log, 7, held=[1])[1] == []
    with_rate_alone = near_first(log, 7, held=[0, 1, 2])
    assert with_rate_alone[1] == []


def test_steps_across_gaps_and_padding_are_left_out():
    log = falling(120)
    log["time"] = torch.arange(8.0).expand(120, 8).unsqueeze(-1).clone()
    log["time"][:, 1:] += 3.0  # during the first step
    log["mask"] = torch.ones(120, 8, dtype=torch.bool)
    log["mask"][:, 3:] = False
    near, _ = near_first(log, 3)
    kept = log["observation"][:, 1:3].flatten(0, 1)
    assert (near["observation"] == kept).all(-1).any(-1).all()
    assert (near["time"] > 3).all()


def test_a_model_of_these_steps_has_the_plants_slopes():
    log = falling(300)
    near, still = near_first(log, 3)
    moving = without(near, still, 3)
    assert (moving["observation"][..., 1] == 0).all()
    assert (near["observation"][..., 1] > 0.9).all(), "a copy"
    A, B = identify(moving, 1, structure="tied", held=still).model[:2]
    slopes = torch.tensor([[1.25, 0, 0.5], [0, 1, 0], [0.5, 0, 1]]).double()
    assert_close(A, slopes, atol=0.03, rtol=0)
    assert_close(B, torch.tensor([[0.15], [0], [0.3]]).double(), atol=0.03, rtol=0)
    of_all = identify(log, 1, structure="tied").model.A
    assert (of_all - slopes).abs().max() > 0.1


def test_a_short_log_has_none():
    assert local_steps(falling(20), 3) is None
