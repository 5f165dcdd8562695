"""`Controller.improve`: its gradient, its cost, what it gains, and what it refuses."""

import copy
import functools
from typing import Any

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.problems import central_difference
from tests.refused import refused
from torch_qpmpc import QPError
from torch_qpmpc.control import learning
from torch_qpmpc.control.review import Finding, Review
from torch_qpmpc.control.simulation import Run
from torch_qpmpc.identification.log import Log
from torch_qpmpc.learning.closed_loop import _Loops, ensemble

LEARN = ("H", "H_f", "q", "b", "C", "lb", "ub")
CASES = {
    "bounds": {"y_bounds": (19.0, 21.0)},
    "prices": {"linear": {"q": "price"}, "dR": 0.5, "du_bounds": (-2.0, 2.0)},
    "limits": {"y_bounds": {"T": (None, "top")}, "dR": 0.5},
    "preview": {"references": "preview", "R": 0.1, "y_bounds": (19.0, 21.0)},
    "blocks": {"blocks": [1, 2, 2], "dR": 0.5, "disturbances": None, "u_bounds": (0.0, 40.0)},
}
#: Short loops near a bound, and known signals.
QUICK: dict[str, Any] = {"r": [20.9], "spread": 0.2, "updates": 4, "loops": 8, "steps": 15}
QUICK |= {"held_out": 64, "members": 2}
NOW = {"d": 0.0, "price": 1.0, "top": 21.0}


@functools.cache
def logged() -> Log:
    """Return a noisy tank's signals with a known load, a price and a limit."""
    rng, T, q = np.random.default_rng(0), np.full(400, 20.0), rng_levels()
    d, price = 5 * np.sin(np.arange(400) / 9), 1 + np.sin(np.arange(400) / 5)
    for k in range(399):
        T[k + 1] = 20 + 0.8 * (T[k] - 20) + 0.2 * (q[k] - 5) + 0.05 * d[k] + 0.3 * rng.normal()
    signals = {"T": T, "q": q, "d": d, "price": price, "top": 21 + 0.3 * np.cos(np.arange(400) / 7)}
    return qm.read_log(signals, outputs=["T"], inputs=["q"], known=["d", "price", "top"])


def rng_levels() -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 10, 100).repeat(4)


@functools.cache
def model():
    return qm.identify(logged(), order=1)


def made(case: str, learn=LEARN) -> qm.Controller:
    plant = model().model
    E = plant.E * [1.0, 0.0, 0.0]
    names = {"outputs": ["T"], "inputs": ["q"], "known": ["d", "price", "top"], "E": E}
    options = {"Q": 1.0, "u_bounds": (0.0, 10.0), **names, **CASES[case]}
    mpc = qm.LinearMPC((plant.A, plant.B, plant.C), 5, **options, learn=learn)
    return qm.Controller(mpc)


def loops(controller: qm.Controller) -> learning.ControlledPlant:
    models, middle, size = ensemble(model(), 1, 0), np.array([20.3]), np.array([0.6])
    return learning.ControlledPlant(controller._law, models, logged(), middle, size)


@pytest.mark.parametrize("case", CASES)
def test_its_gradient_is_that_of_finite_differences(case):
    """Through the observer, the target and the QP, along random directions."""
    controller = made(case)
    mpc, plant = controller.mpc.plan, loops(controller)

    def cost() -> torch.Tensor:
        return _Loops(plant, 3, 3).run(mpc, 6).costs.mean()

    _Loops(plant, 3, 3).mean_cost(mpc, 6).backward()
    generator, moved = torch.Generator().manual_seed(2), set()
    for name, leaf in mpc.coordinates().items():
        if not isinstance(leaf, torch.nn.Parameter) or leaf.grad is None:
            continue
        direction = torch.randn(leaf.shape, generator=generator).double() * leaf.detach().abs()
        direction = direction.nan_to_num(posinf=0.0, neginf=0.0)
        if not (size := direction.norm()) > 0:
            continue
        direction = direction / size
        expected = central_difference(cost, leaf, direction, 1e-5)
        got = (leaf.grad * direction).nan_to_num().sum()
        torch.testing.assert_close(got, expected, rtol=1e-3, atol=1e-5, msg=name)
        moved |= {name} if abs(got) > 1e-3 else set()
    assert len(moved) >= 3


@pytest.mark.parametrize("case", CASES)
def test_its_loops_are_the_controllers_own(case):
    """The controller's steps have the same inputs, and `Run.costs` the same costs."""
    controller = made(case)
    plant, law = loops(controller), controller._law
    draw = torch.Generator().manual_seed(3)
    s = plant.starts(draw, 3)
    with torch.no_grad():
        for _ in range(6):
            base, u_last, r, u_s, p = s.split(plant._ends, -1)
            _, e, y, *_ = plant._parts(base)
            a = controller.mpc.plan.policy(p)
            u, costs = u_s + a, plant.cost(s, a)
            place = law.design.places["u_r"]
            u_s = u_s + p[:, place] if place.stop else u_s  # of the first stage
            ahead = plant._ahead(base, 5).numpy()
            for i in range(3):
                begun = law.begun(u_last[i].numpy())
                begun = begun._replace(e=e[i].numpy())
                rows = np.tile(r[i].numpy(), (6, 1))
                seen = law.observer.H @ e[i].numpy()  # which corrects nothing
                move = law.step(begun, seen, rows, ahead[i])
                np.testing.assert_allclose(move.u, u[i], rtol=1e-6, atol=1e-6)
                one = (y[i : i + 1], r[i : i + 1], u[i : i + 1])
                ys, rs, us = (x.numpy() for x in one)
                both = np.vstack((ys, ys)), np.vstack((rs, rs))
                run = Run(law.design, *both, us, ahead[i][:1], u_s[i : i + 1].numpy(), begun.u)
                np.testing.assert_allclose(run.cost[0], costs[i], rtol=1e-6, atol=1e-6)
            s = plant.step(s, a, plant.draw(draw, 3))


def test_it_stays_away_from_a_bound_that_noise_violates():
    controller = made("bounds", learn=("H", "H_f", "lb", "ub"))
    controller.reset(y={"T": 20.0}, u={"q": 5.0}, known=NOW)
    before, u = copy.deepcopy(controller.mpc.plan.state_dict()), controller.u
    report = controller.improve(logged(), **QUICK)
    assert report.kept
    assert report.after < 0.9 * report.before
    assert len(report.curve) == 4
    assert not all(torch.equal(before[k], x) for k, x in controller.mpc.plan.state_dict().items())
    with pytest.raises(QPError, match="NaN"):
        controller.mpc.target([np.nan], known=[0.0, 1.0, 21.0])
    assert np.array_equal(controller.u, u)
    assert 0 <= controller.step(y={"T": 20.5}, r={"T": 20.9}, known=NOW)["q"] <= 10


def test_the_outputs_still_settle_at_r():
    """What would move the steady state is held, and the report says so; r is held in loops, too."""
    controller = made("bounds", learn=("H", "H_f", "q", "b"))
    controller.reset(y={"T": 20.0}, u={"q": 5.0}, known=NOW)
    report = controller.improve(logged(), **QUICK)
    assert report.kept
    assert "Held, as outputs would settle beside r: q, b." in str(report)
    assert set(controller.mpc.plan.learned) == {"H", "H_f", "q", "b"}
    for r in (19.5, 20.7):
        T = 20.0
        for _ in range(60):
            q = controller.step(y={"T": T}, r={"T": r}, known=NOW)["q"]
            T = 20 + 0.8 * (T - 20) + 0.2 * (q - 5)
        assert abs(T - r) < 1e-4


def test_half_of_the_loops_hold_their_set_points():
    plant = loops(made("bounds"))
    draw, held = torch.Generator().manual_seed(0), []
    s = plant.starts(draw, 6)
    for _ in range(9):
        held.append(s.split(plant._ends, -1)[2][:, 0])
        s = plant.step(s, s.new_zeros(6, 1), plant.draw(draw, 6))
    moved = torch.stack(held).std(0) > 0
    assert moved.tolist() == [True, False] * 3


def test_a_theta_with_a_new_fault_is_not_kept(monkeypatch):
    """The review's question to the loop has another answer with it."""
    controller = made("bounds", learn=("H", "H_f", "lb", "ub"))
    mpc, answers = controller.mpc, []

    def asked(*arguments: object) -> Review:
        answers.append(len(answers) > 0)
        return Review([Finding("offset", not answers[-1], "outputs settle beside r")])

    monkeypatch.setattr("torch_qpmpc.control.controller.review", asked)
    report = controller.improve(logged(), **QUICK)
    assert not report.kept
    assert str(report).endswith("With it, offset: outputs settle beside r.")
    assert answers == [False, True]
    assert controller.mpc is mpc


def test_what_is_no_better_leaves_the_controller_as_it_was():
    controller = made("blocks")
    mpc = controller.mpc
    few: Any = {"updates": 1, "loops": 2, "steps": 5, "held_out": 16, "members": 2}
    report = controller.improve(logged(), rate=1e-9, **few)
    assert not report.kept
    assert controller.mpc is mpc


@refused(({"members": 0}, "members: got 0"), ({"seed": -1}, "seed: got -1"))
def test_improve_refuses(change):
    made("bounds").improve(logged(), **change)


def test_levels_are_refused_before_a_model_is_identified():
    mpc = qm.LinearMPC(([[0.9]], [[0.5]]), 5, Q=1.0, u_levels={"u1": (0, 1)}, learn=("H",))
    with pytest.raises(QPError, match=r"^mpc: got one with levels"):
        qm.Controller(mpc).improve("no file is read")
