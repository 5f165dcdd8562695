"""Ensembles of models of a log: what they share, their cost, and J that they predict."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

import torch_qpmpc as qm
from tests.logs import arx_log
from tests.runs import SMALL, make_config
from torch_qpmpc import QPError
from torch_qpmpc.envs import Plant, PointMass
from torch_qpmpc.envs.closed_loop import closed_loop
from torch_qpmpc.experiment.ensemble import (
    BLOCKS,
    MEMBERS,
    check_ensemble,
    ensemble,
    predict_cost,
    run_ensemble,
)
from torch_qpmpc.experiment.start import collect_log
from torch_qpmpc.experiment.tasks import make_physics
from torch_qpmpc.learning.operators import warm_policy
from torch_qpmpc.mpc.layout import Layout

DATA = ("start=data", "start.transitions=1200", "num_envs=24")
BOUNDS = torch.tensor([-1.0]).double(), torch.tensor([1.0]).double()
LAYOUT = Layout(2, 1, 3, 2, 1)


def plant_of(cfg: DictConfig) -> Plant:
    plant = make_physics(cfg)
    assert isinstance(plant, Plant)
    return plant


def test_J_of_a_policy_is_predicted_from_a_log_of_another():
    lb, ub = (x * torch.tensor([100.0, 100, 100, 100]).double() for x in (-1, 1))
    physics = PointMass(lb_s=lb, ub_s=ub)
    log = physics.vectorised(200, 25, seed=3).rollout(25)
    options = {"stage_weight": [1.0] * 4 + [0.1] * 2, "action_bounds": ([-1] * 2, [1] * 2)}
    for N in (2, 10):
        mpc = qm.QPMPC.from_model(physics.A, physics.B, N, solver="daqp", **options)
        true = closed_loop(warm_policy(mpc), physics, steps=25, starts=256, seed=5).J
        own = predict_cost(mpc, log, lambda y, u, d: physics.cost(y, u), steps=25, starts=256)
        fitted = predict_cost(mpc, log, steps=25, starts=256)
        assert own.low < true < own.high
        assert abs(own.J - true) < 0.1 * true
        assert abs(fitted.J - own.J) < 0.02 * own.J


def test_members_differ_in_their_data_and_start_as_the_logs_trajectories_do():
    log = arx_log(episodes=6, noise=0.1)
    models = ensemble(log, LAYOUT, lambda y, u, d: y[..., 0], *BOUNDS)
    assert len(models) == MEMBERS
    for i, one in enumerate(models):
        assert not any(torch.equal(one.A, other.A) for other in models[:i])
        assert len(one.errors) < log.numel() / 2
        starts = one.starts(np.random.default_rng(0), 50)
        known = one.signals(np.random.default_rng(0), 50, 3)[..., :1]
        window = torch.cat(
            (log["observation"][:, 0], torch.zeros(6, 1), log["observation"][:, 0]), -1
        )
        assert (starts[:, None] == window).all(-1).any(1).all()
        assert (known[:, None, :, 0] == log["preview"][:, :3, 0]).all(-1).any(1).all()
    again = ensemble(log, LAYOUT, lambda y, u, d: y[..., 0], *BOUNDS)
    assert torch.equal(again[0].A, models[0].A)


def test_the_run_has_the_plants_cost_or_one_fitted_to_rewards(store_task):
    other = make_config("task=store", *DATA)
    physics = plant_of(other)
    with pytest.warns(UserWarning, match="explains"):  # it is piecewise linear
        (member, *_) = run_ensemble(other, physics, None, collect_log(other, physics))
    assert member.past == physics.past == 2


@pytest.mark.parametrize(
    ("steps", "message"),
    [(6, "trajectories: got 8 transitions in 8"), (14, "of which no half determines a model")],
)
def test_a_log_that_is_too_short_for_the_members_is_named(steps, message):
    with pytest.raises(QPError, match=message):
        ensemble(arx_log(steps=steps, noise=0.1), LAYOUT, lambda y, u, d: y[..., 0], *BOUNDS)


def test_what_the_start_holds_its_members_hold():
    log = arx_log(noise=0.1)
    members = ensemble(log, LAYOUT, lambda y, u, d: y[..., 0], *BOUNDS, held=[0])
    assert all((member.B[0] == 0).all() for member in members)


def test_a_policy_with_a_window_and_a_log_without_bounds():
    log = arx_log(noise=0.1)
    options = {"stage_weight": [1.0, 1.0, 0.1], "action_bounds": ([-1.0], [1.0])}
    mpc = qm.QPMPC.from_data(log, 3, past=2, n_d=1, **options)
    J, low, high = predict_cost(mpc, log, lambda y, u, d: y.square().sum(-1), steps=5, starts=8)
    assert low <= J <= high


def test_a_prediction_needs_a_cost():
    mpc = qm.QPMPC(2, 1, 3, past=2, n_d=1, solver="daqp")
    with pytest.raises(QPError, match="a log without rewards"):
        predict_cost(mpc, arx_log(noise=0.1))
    with pytest.raises(QPError, match="mpc: got int, expected a QPMPC"):
        predict_cost(3, arx_log(noise=0.1))  # pyright: ignore[reportArgumentType]


def test_a_run_with_too_few_transitions_for_an_ensemble_says_so_at_its_start(tmp_path):
    cfg = make_config(*SMALL, "gate=model")
    physics = make_physics(cfg)
    least = 4 * (7 + BLOCKS)
    message = (
        f"gate: got 'model' with 32 transitions before the first .*, expected at least {least}"
    )
    with pytest.raises(QPError, match=message):
        check_ensemble(cfg, physics, None)
    cfg.warmup_steps = least // cfg.num_envs - 4
    check_ensemble(cfg, physics, None)
