"""The tanks' rivals: their order of costs, the filter, and DeePC against its definition."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torch_qpmpc as qm
from torch_qpmpc.envs import FourTanks, TankReferences
from torch_qpmpc.envs.closed_loop import plant_loop
from torch_qpmpc.experiment.rivals.deepc import DeePC, hankel_matrices, uniform_log
from torch_qpmpc.experiment.rivals.linear_mpc import KalmanMPC
from torch_qpmpc.experiment.rivals.tanks import FOUR_TANKS_RIVALS, TANK_REFERENCES_RIVALS
from torch_qpmpc.experiment.tracking import set_point_scheme, window_model


def test_more_knowledge_costs_less_at_the_set_point():
    """All costs have the 35.5 of x_0, which no policy changes."""
    p = FourTanks()
    J = {
        name: plant_loop(*rival.of(p), steps=100, starts=16, seed=3).J
        for name, rival in FOUR_TANKS_RIVALS.items()
    }
    filters = [J[f"Kalman filter, N = {N}"] for N in (60, 40, 20)]
    assert filters == sorted(filters)
    assert J["omniscient"] < filters[0] < J["DeePC"] < filters[2]
    # Of several logs and seeds, the costs are 213, 214, 232 and 218.
    assert filters == pytest.approx([214, 215, 232], abs=6)
    assert J["DeePC"] == pytest.approx(219, abs=7)


def test_more_knowledge_costs_less_for_references():
    p = TankReferences(noise_std=0.1, mismatch=1.0)
    J = {}
    for name, rival in TANK_REFERENCES_RIVALS.items():
        J[name] = plant_loop(*rival.of(p), steps=60, starts=8, seed=3).J / 60
    assert J["omniscient"] < min(J["offset-free"], J["exact MPC"])
    still = plant_loop(lambda y: torch.zeros(8, 2), p, steps=60, starts=8, seed=3).J / 60
    assert still > 1.2 * max(J.values())


def test_the_filter_has_the_error_of_its_riccati_equation():
    p = FourTanks()
    estimates = []

    def still(x):
        estimates.append(x)
        return torch.zeros(len(x), 2).double()

    C, V, E = p.measurement()
    policy = KalmanMPC(still, p.A, p.B, C, V, E, torch.zeros(4).double())
    states = []

    class Recorder(FourTanks):
        def step(self, x, u, w):
            states.append(x)
            return super().step(x, u, w)

    plant_loop(policy, Recorder(), steps=150, starts=200, seed=0)
    errors = (torch.stack(estimates) - torch.stack(states))[100:].flatten(0, 1)
    P = 1e3 * torch.eye(4).double()  # the error's covariance, by iteration
    for _ in range(500):
        P = p.A @ P @ p.A.mT + V
        P = P - P @ C.mT @ torch.linalg.solve(C @ P @ C.mT + E, C @ P)
    torch.testing.assert_close(errors.mT @ errors / len(errors), P, atol=5e-5, rtol=0.05)


def test_deepc_solves_its_definition():
    p = FourTanks(horizon=4, past=3)
    log = uniform_log(p, 60, seed=2)
    Q, R = torch.tensor([35.0, 20.0]).double(), torch.tensor([0.1, 0.2]).double()
    y_r, u_r = p.r, p.set_point()[1]
    lambda_g, lambda_y = 0.3, 7.0
    options: dict[str, Any] = {"Q": Q, "R": R, "lambda_g": lambda_g, "lambda_y": lambda_y}
    options |= {"y_r": y_r, "u_r": u_r, "lb_u": p.lb_a, "ub_u": 0.58 * p.ub_a}
    policy = DeePC(log, p.past, p.horizon, **options)
    window = torch.randn(6, p.n_p, generator=torch.Generator().manual_seed(0)).double() / 2

    P, U, Y = hankel_matrices(log, p.past, p.horizon, p.n_y)
    count = P.shape[1]
    assert count == 60 - 3 - 4 + 2
    is_output = torch.arange(p.n_p) % 4 < 2
    known = torch.cat((P, U))
    Pi = torch.eye(count).double() - torch.linalg.pinv(known) @ known
    H = 2 * lambda_g * Pi.mT @ Pi + 1e-9 * torch.eye(count).double()
    q = torch.zeros(1, count).double()
    targets = {"Y": y_r.repeat(4), "U": u_r.repeat(4), "past": window[:, is_output]}
    parts = {"Y": (Y, Q.repeat(4)), "U": (U, R.repeat(4))}
    parts["past"] = (P[is_output], torch.full((6,), lambda_y).double())
    for name, (rows, weight) in parts.items():
        H = H + 2 * rows.mT @ (weight.unsqueeze(-1) * rows)
        q = q - 2 * (weight * targets[name]) @ rows
    by_hand = qm.solve_qp(
        qm.QuadraticProgram(
            H=(H + H.mT) / 2,
            q=q,
            c=torch.zeros(()).double(),
            C=P[~is_output],
            b=window[:, ~is_output],
            G=U,
            lb=options["lb_u"].repeat(4),
            ub=options["ub_u"].repeat(4),
            w=torch.full((8,), torch.inf).double(),
        ),
        solver="daqp",
    )
    first = by_hand.z @ U[:2].mT
    at_bound = (first - options["ub_u"]).abs() < 1e-6
    assert 0 < at_bound.sum() < at_bound.numel()
    torch.testing.assert_close(policy(window), first, atol=1e-4, rtol=0)


def test_a_log_has_uniform_actions_and_seeds_of_its_own():
    p = FourTanks(past=3)
    log = uniform_log(p, 300, seed=1, episodes=2)
    assert log.shape == (2, 300)
    u = log["action"].double()
    assert u.abs().max() <= 2
    assert u.std().item() == pytest.approx(4 / 12**0.5, rel=0.05)
    again, other = (uniform_log(p, 300, seed, episodes=2) for seed in (1, 2))
    assert torch.equal(log["observation"], again["observation"])
    assert not torch.isclose(log["action"], other["action"]).all(-1).any()
    # The next window is the last one with the action and a new output.
    following = log["next", "observation"]
    torch.testing.assert_close(following[..., :-4], log["observation"][..., 4:])
    torch.testing.assert_close(following[..., -4:-2], log["action"])


def test_identified_from_a_log_the_tanks_cost_little_more_than_with_the_true_model():
    p = FourTanks()
    log = uniform_log(p, 1000, seed=1)
    found = qm.identify(log, p.horizon, past=p.past, n_x=2, ridge=0.0)
    identified = qm.Model(*found.model, *found.constraints)
    true = qm.Model(*window_model(p.A, p.B, *p.measurement(), p.past))
    schemes = (set_point_scheme(p, model, 1.0) for model in (identified, true))
    policies = (qm.QPMPC(scheme, solver="daqp").policy for scheme in schemes)
    J = [plant_loop(policy, p, steps=100, starts=16, seed=3).J for policy in policies]
    assert J[0] == pytest.approx(218, abs=8)
    assert J[0] < 1.03 * J[1]
