"""Nonlinear MPC: simulations, the search for plans, its status, and gradients of V, Q and pi."""

from __future__ import annotations

import copy
import pickle
import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torch_qpmpc as qm
from tests.refused import refused
from tests.transitions import transitions
from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.analysis.structure import predictions
from torch_qpmpc.identification.learned import LearnedModel
from torch_qpmpc.learning.operators import QPActorValueOperator, warm_policy
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.mpc import nonlinear
from torch_qpmpc.mpc.nonlinear import of_networks
from torch_qpmpc.proofs import Polytope, largest_difference
from torch_qpmpc.qp.program import Status

N = 5
LEARN = ("H", "H_f", "q", "c", "lb", "ub", "w")


class Pendulum(nn.Module):
    """A pendulum with a torque, a known load if ``known``, and a stage cost if ``priced``."""

    def __init__(self, known: bool = False, priced: bool = False) -> None:
        super().__init__()
        self.gravity = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
        self.price = nn.Parameter(torch.tensor(0.5, dtype=torch.float64))
        self.known, self.priced = known, priced
        self.step = qm.RungeKutta(self.rates, 0.1, steps=2)

    def rates(self, x: Tensor, u: Tensor, *d: Tensor) -> Tensor:
        angle, rate = x.unbind(-1)
        load = d[0][..., 0] * angle.cos() if self.known else 0.0
        return torch.stack((rate, self.gravity * angle.sin() - 0.2 * rate + u[..., 0] + load), -1)

    def forward(self, x: Tensor, u: Tensor, *d: Tensor) -> Any:
        after = self.step(x, u, *d)
        cost = self.price * (1 - x[..., 0].cos()) + 0.1 * u[..., 0].sin() ** 4
        return (after, cost) if self.priced else after


def made(known: bool = False, priced: bool = False, **options: Any) -> QPMPC:
    options = {"iterations": 100, "learn": LEARN, "action_bounds": ([-1.5], [1.5])} | options
    options = {"stage_weight": [1.0, 0.1, 0.1], "solver": "daqp"} | options
    options = {"dynamics": Pendulum(known, priced)} | options
    return QPMPC.of(2, 1, N, int(known), **options)


def states(mpc: QPMPC, count: int = 4, size: float = 0.6, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(count, mpc.n_p, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("n_d", [0, 1])
@pytest.mark.parametrize("priced", [True, False])
def test_derivatives_are_those_of_automatic_differentiation(n_d, priced):
    rng = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    n, m, K, width = n_d + 3, 2 + priced, 2, 4
    layers = [random(n, K * width), random(K * width), random(K, width, width)]
    layers += [random(K, 1, width), random(K * width, m), random(m)]
    size = 1 + n + priced * n * (n + 1) // 2
    for own in ((), layers):
        model = LearnedModel(random(n), random(n).exp(), random(size, m), 2, own)
        w = random(5, n)

        def outputs(w: Tensor, model: LearnedModel = model) -> Tensor:
            d, x, u = w.split((n_d, 2, 1), -1)
            out = model(x, u, *(d,) * n_d)
            return torch.cat((out[0], out[1][..., None]), -1) if isinstance(out, tuple) else out

        out, J, W = of_networks(model, w)
        J[:, :2, n_d : n_d + 2] += torch.eye(2)  # x+ is x and its change
        out[:, :2] += w[:, n_d : n_d + 2]
        assert_close(out, outputs(w))
        assert_close(J, torch.func.vmap(torch.func.jacrev(outputs))(w))
        if priced:
            cost = torch.func.hessian(lambda w: outputs(w)[-1])
            assert_close(W, torch.func.vmap(cost)(w))


def test_runge_and_kutta_are_of_fourth_order():
    x, u = torch.ones(3, 1).double(), torch.zeros(3, 1).double()
    errors = [
        (qm.RungeKutta(lambda x, u: u - x, 1.0, steps)(x, u) - torch.tensor(-1.0).exp()).abs().max()
        for steps in (2, 4)
    ]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)
    with pytest.raises(QPError, match="steps: got 0"):
        qm.RungeKutta(lambda x, u: x, 0.1, steps=0)


def test_linear_dynamics_have_the_solution_of_the_qp():
    A, B = torch.tensor([[1.0, 0.1], [0.0, 0.9]]).double(), torch.tensor([[0.0], [0.5]]).double()
    options: Any = {"stage_weight": [1.0, 0.1, 0.1], "action_bounds": ([-0.3], [0.3])}
    options |= {"learn": (), "solver": "daqp", "state_bounds": ([-9.0, -0.2], [9.0, 0.2])}
    linear = QPMPC.of(2, 1, N, A=A, B=B, offset=[0.01, 0.0], **options)
    offset = torch.tensor([0.01, 0.0]).double()
    mpc = QPMPC.of(2, 1, N, dynamics=lambda x, u: x @ A.T + u @ B.T + offset, **options)
    assert_close(mpc.C_0, linear.C_0)
    assert_close(mpc.b, linear.b)
    s, a = states(mpc), torch.full((4, 1), 0.1).double()
    assert_close(mpc.value(s), linear.value(s))
    assert_close(mpc.action_value(s, a), linear.action_value(s, a))
    assert_close(mpc.policy(s), linear.policy(s), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("priced", [False, True])
def test_a_converged_plan_is_a_local_minimum_of_the_simulated_cost(priced):
    mpc = made(priced=priced)
    s = states(mpc)
    solution: Any = mpc.solve(s)
    assert solution.converged.all()
    assert solution.strict.all()
    assert solution.defect.max() < 1e-6
    assert solution.residual.max() < 1e-6
    qp, search = mpc.quadratic_program(), mpc.sequential

    def cost(u: Tensor) -> Tensor:
        z, costs = search.simulated(s, u)
        return costs + (z @ qp.H * z).sum(-1) / 2

    with torch.no_grad():
        assert_close(cost(solution.plan), solution.value, rtol=1e-6, atol=1e-8)
        for seed in range(20):
            change = torch.randn(4, N, 1, generator=torch.Generator().manual_seed(seed)).double()
            other = (solution.plan + 0.03 * change).clamp(-1.5, 1.5)
            assert (cost(other) >= solution.value - 1e-8).all()


CASES: list[dict[str, Any]] = [
    {},
    {"known": True, "priced": True},
    {"state_bounds": ([-1.0, -0.4], [1.0, 0.4]), "state_slack": 5.0},
    {"state_bounds": ([-9.0, -0.8], [9.0, 0.8]), "state_slack": torch.inf},
    {"blocks": (1, 2, 2)},
]


def slope_along(function: Any, point: list[Tensor], change: list[Tensor]) -> Tensor:
    """Return the central difference of a function's sum, with the point moved in place."""
    sides = []
    with torch.no_grad():
        start = [x.clone() for x in point]
        for eps in (1e-5, -1e-5, 0.0):
            for x, x_0, dx in zip(point, start, change, strict=True):
                x.copy_(x_0 + eps * dx)
            sides.append(function().sum() if eps else None)
    return (sides[0] - sides[1]) / 2e-5


@pytest.mark.parametrize("case", CASES, ids=lambda case: ", ".join(case) or "plain")
def test_gradients_equal_finite_differences(case):
    """At the origin, near it, and where bounds are active."""
    mpc = made(**case)
    s = torch.cat([states(mpc, 3, size, seed=4) for size in (0.3, 0.0, 0.9)])
    if case.get("state_slack") == torch.inf:
        s *= 0.5  # from which the bounds can be kept
    a = torch.tensor([[0.2], [-0.7], [1.0]]).double().repeat(3, 1)
    functions = {
        "V": lambda: mpc.value(s),
        "Q": lambda: mpc.action_value(s, a),
        "pi": lambda: mpc.policy(s),
    }
    point, generator = [s.requires_grad_(), *mpc.parameters()], torch.Generator().manual_seed(1)
    for name, function in functions.items():
        change = [torch.randn(x.shape, generator=generator).to(x) for x in point]
        found = torch.autograd.grad(function().sum(), point, allow_unused=True)
        pairs = zip(found, change, strict=True)
        own = torch.stack([(x * dx).sum() for x, dx in pairs if x is not None]).sum()
        other = slope_along(function, point, change)
        assert_close(own, other, rtol=1e-4, atol=1e-4, msg=lambda m, n=name: f"{n}: {m}")


def test_an_action_value_of_horizon_one_has_gradients():
    """No action is left to plan."""
    mpc = QPMPC.of(2, 1, 1, dynamics=Pendulum(), stage_weight=[1.0, 0.1, 0.1], solver="daqp")
    s, a = states(mpc).requires_grad_(), torch.full((4, 1), 0.1).double().requires_grad_()
    assert torch.autograd.gradcheck(mpc.action_value, (s, a), eps=1e-5, atol=1e-4)


def test_a_saddle_says_that_the_plan_has_no_gradient():
    def hilltop(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return x + 0.1 * u, 1e6 * x[..., 0] ** 4 - x[..., 0] ** 2

    options: Any = {"stage_weight": [0.0, 1e-3], "action_bounds": ([-1.0], [1.0]), "solver": "daqp"}
    mpc = QPMPC.of(1, 1, 4, dynamics=hilltop, **options)
    s = torch.tensor([[0.0], [0.05]]).double().requires_grad_()
    solution: Any = mpc.solve(s)
    assert solution.converged.all()
    assert solution.strict.tolist() == [False, True]
    with pytest.warns(RuntimeWarning, match="1 of 2 plans have a gradient of zero"):
        gradient = torch.autograd.grad(mpc.policy(s).sum(), s)[0]
    assert gradient[0] == 0
    assert gradient[1] != 0
    assert gradient.isfinite().all()
    mpc.on_failure = "mask"
    with warnings.catch_warnings(action="error"):
        mpc.policy(s)


@pytest.mark.parametrize("unit", [1e-18, 1.0, 1e12])
def test_a_bound_holds_a_concave_cost_in_all_units(unit):
    def dynamics(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return x + 0.1 * u, -unit * u[..., 0] ** 2

    options: Any = {"stage_weight": [0.3 * unit, 0.0], "action_bounds": ([-1.0], [1.0])}
    mpc = QPMPC.of(1, 1, 3, dynamics=dynamics, solver="daqp", **options)
    s = torch.ones(1, 1).double().requires_grad_()
    solution: Any = mpc.solve(s)
    assert solution.strict.all()
    (slope,) = torch.autograd.grad(solution.z.sum(), s)  # of x_0, .., x_3
    assert slope.item() == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("units", "hard"),
    [((1e-6, 1e5, 1e4), True), ((1e5, 1e-6, 1.0), False), ((1.0, 1e4, 1e-8), True)],
)
def test_plans_and_gradients_do_not_depend_on_the_units(units, hard):
    bounds = {"state_bounds": ([-1.0, -2.0], [3.0, 2.0]), "action_bounds": ([-1.5], [1.5])}
    s = torch.tensor([[2.5, 0.0], [0.5, -1.0], [-0.9, 0.2]], dtype=torch.float64)

    def found(x_unit: float, u_unit: float, cost: float) -> tuple[Tensor, ...]:
        plant, sizes = Pendulum(), {"state_bounds": x_unit, "action_bounds": u_unit}
        own: dict[str, Any] = {
            k: [[x * sizes[k] for x in side] for side in v] for k, v in bounds.items()
        }
        weight = [cost / x_unit**2, 0.1 * cost / x_unit**2, 0.1 * cost / u_unit**2]
        own |= {"stage_weight": weight, "state_slack": torch.inf if hard else 5 * cost / x_unit}

        def dynamics(x: Tensor, u: Tensor) -> Tensor:
            return plant(x / x_unit, u / u_unit) * x_unit

        mpc = QPMPC.of(2, 1, 15, dynamics=dynamics, solver="daqp", learn=(), **own)
        p = (s * x_unit).requires_grad_()
        solution: Any = mpc.solve(p)
        assert solution.converged.all()
        assert solution.strict.all()
        (slope,) = torch.autograd.grad(mpc.policy(p).sum(), p)
        return solution.value / cost, solution.plan / u_unit, slope * x_unit / u_unit

    assert_close(found(*units), found(1.0, 1.0, 1.0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e3, 1.0), (1e6, 1.0), (1.0, 1e3)])
def test_plans_for_a_stage_cost_do_not_depend_on_the_units(units):
    """A decaying catalyst in mol/l and K cost 8.55: its cost had the curvature of other units."""
    c_unit, T_unit = units

    def catalyst(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        c, T = x[..., 0] / c_unit, x[..., 1] / T_unit
        c = c * (-5e5 * (-6000 / T).exp()).exp()
        after = torch.stack((c * c_unit, x[..., 1] + 0.2 * (u[..., 0] - x[..., 1])), -1)
        return after, 1e3 * c + 1e-5 * (T - 300) ** 2

    model = {"A": torch.eye(2), "B": torch.zeros(2, 1), "stage_weight": torch.zeros(3)}
    bounds: Any = {"action_bounds": ([300.0 * T_unit], [450.0 * T_unit]), "gamma": 1.0}
    mpc = QPMPC.of(2, 1, 20, dynamics=catalyst, solver="daqp", **model, **bounds)
    s = torch.tensor([[1e-3, 380.0], [2e-3, 350.0]]).double() * torch.tensor(units)
    assert_close(mpc.value(s), torch.tensor([5.931938, 12.891113]).double(), rtol=1e-5, atol=0)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3, 1e6])
def test_plans_on_their_bounds_are_within_them_and_converge(unit):
    """Dosing was 5e-7 above its bound, relatively, and whole steps were refused for it."""

    def tank(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        x, u = x / unit, u / unit
        ion = x[..., 0] + 0.2 * (u[..., 0] - 1e-3 - x[..., 0])
        acid = ((ion**2 + 4e-10).sqrt() - ion) / 2
        after = torch.stack((ion, 0.9 * x[..., 1] + 0.1 * x[..., 0]), -1)
        return after * unit, (acid.log10() + 5) ** 2

    bounds: Any = {"action_bounds": ([0.0], [2e-3 * unit]), "gamma": 1.0, "stage_weight": [0.0] * 3}
    mpc = QPMPC.of(2, 1, 20, dynamics=tank, solver="daqp", **bounds)
    solution: Any = mpc.solve(
        torch.tensor([[x * unit, 0.0] for x in (-9e-4, -5e-4, 1e-4, 5e-4)]).double()
    )
    assert solution.converged.all()
    assert solution.plan.min() >= 0
    assert solution.plan.max() <= 2e-3 * unit * (1 + 1e-15)
    want = torch.tensor([4.728462, 1.695495, 0.0, 1.695495]).double()
    assert_close(solution.value, want, rtol=1e-5, atol=1e-6)


def test_a_signal_that_only_rounding_moves_has_no_curvature(monkeypatch):
    """A constant target had one of 1e19: rounding of eigenvectors in units of rounding."""

    def arm(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        angle, speed, target = x.unbind(-1)
        u = u[..., 0]
        after = angle + 0.1 * speed, 0.9 * speed + u, target + 1e-18 * speed
        far = (angle.sin() - 50 * target) ** 2 + 0.1 * (angle.cos() - target * speed) ** 2
        return torch.stack(after, -1), far + 1e-2 * u**2 + 1e-3 * (speed - target) ** 2

    own, curvatures = nonlinear.solve, []

    def spy(*arguments: Any) -> Any:
        curvatures.append(arguments[0].H.abs().max())
        return own(*arguments)

    monkeypatch.setattr(nonlinear, "solve", spy)
    bounds: Any = {"action_bounds": ([-10.0], [10.0]), "gamma": 1.0, "stage_weight": [0.0] * 4}
    mpc = QPMPC.of(3, 1, 20, dynamics=arm, solver="daqp", **bounds)
    value = mpc.value(torch.tensor([[1.0, 0.0, 0.0181], [0.2, 0.5, -0.0181]]).double())
    assert_close(value, torch.tensor([0.25585, 17.666119]).double(), rtol=1e-5, atol=0)
    assert max(curvatures) < 10


def test_a_search_goes_on_nearer_to_its_plan_if_a_qp_is_not_solved(monkeypatch):
    mpc, own, calls = made(priced=True), nonlinear.solve, []

    def failing(*arguments: Any) -> Any:
        calls.append(solution := own(*arguments))
        limit = torch.full_like(solution.status, Status.NOT_CONVERGED)
        return replace(solution, status=limit) if len(calls) == 2 else solution

    s = states(mpc)
    want = mpc.value(s)
    monkeypatch.setattr(nonlinear, "solve", failing)
    solution: Any = mpc.solve(s)
    assert solution.converged.all()
    assert_close(solution.value, want)


def test_a_plan_is_an_argument_and_a_result():
    mpc: Any = made(iterations=1)
    s = states(mpc, size=1.5)
    with torch.no_grad():
        first = mpc.solve(s)
        again = mpc.solve(s, warm_start=first)
        flat = mpc.solve(s, warm_start=first.plan.flatten(1))
        assert_close(again.plan, flat.plan)
        assert (again.value <= first.value + 1e-9).all()
        assert (again.value < first.value).any()
        assert first.later.equal(torch.cat((first.plan[:, 1:], first.plan[:, -1:]), 1)[..., 0])
        one = mpc.solve(s[0], warm_start=first.plan[0])
        assert one.plan.shape == (N, 1)
        assert one.converged.shape == ()
        assert_close(one.plan, again.plan[0])
        nested = mpc.solve(s.view(2, 2, 2), warm_start=first.plan)
        assert_close(nested.z.flatten(0, 1), again.z)
        nothing = mpc.solve(s, warm_start=torch.full_like(first.plan, torch.nan))
        assert_close(nothing.plan, first.plan)
    with pytest.raises(QPError, match=r"warm_start: got shape \(3,\)"):
        mpc.solve(s, warm_start=torch.zeros(3))


def test_real_time_iteration_swings_a_pendulum_up():
    torch.set_default_dtype(torch.float64)
    try:
        model = Pendulum().requires_grad_(False)

        def f(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
            return model(x, u), 1 - x[..., 0].cos() + 0.01 * x[..., 1] ** 2

        bounds: Any = ([-1.2], [1.2])  # less than gravity
        mpc = QPMPC.of(
            2, 1, 25, dynamics=f, iterations=1, gamma=1.0, action_bounds=bounds,
            stage_weight=[0.0, 0.0, 1e-3], solver="daqp", learn=(),
        )  # fmt: skip
        policy, x = warm_policy(mpc), torch.tensor([[torch.pi, 0.0], [2.0, 0.0]])
        for _ in range(70):
            x = model(x, policy(x))
    finally:
        torch.set_default_dtype(torch.float32)
    assert (x[:, 0].cos() > 0.99).all()
    assert (x[:, 1].abs() < 0.1).all()


def bent(x: Tensor, u: Tensor) -> Tensor:
    return x + 0.1 * u.sum(-1, keepdim=True) - 0.6 + 0.3 * torch.sin(3 * x)


ONE_SIDED = ([5.0], [torch.inf]), ([-torch.inf], [-5.0]), ([-20.0], [-15.0]), ([-1.0], [1.0])


@pytest.mark.parametrize("iterations", [1, 30])
@pytest.mark.parametrize(("low", "high"), ONE_SIDED)
def test_actions_are_within_hard_bounds_whatever_the_plan_was(low, high, iterations):
    bounds = {"action_bounds": (low, high), "iterations": iterations, "solver": "daqp"}
    mpc = QPMPC.of(1, 1, 5, dynamics=bent, stage_weight=[1.0, 0.1], **bounds)
    s = torch.linspace(-8, 8, 33).double()[:, None]
    for plan in (None, torch.full((33, 5, 1), 9.0).double()):
        solution: Any = mpc.solve(s, warm_start=plan)
        assert solution.solved.all()
        u = solution.plan[solution.solved]
        assert (u >= low[0] - 1e-6).all()
        assert (u <= high[0] + 1e-6).all()


def test_a_state_from_which_every_plan_leaves_the_region_of_the_dynamics_has_no_plan():
    """The angle after this rate is above one, whatever the torque; from there on f is NaN."""
    plant = Pendulum()

    def limited(x: Tensor, u: Tensor) -> Tensor:
        return torch.where(x[..., :1] > 1, torch.nan, plant(x, u))

    mpc = made(dynamics=limited, on_failure="mask", learn=())
    solution: Any = mpc.solve(torch.tensor([[0.5, 0.0], [0.95, 3.0]], dtype=torch.float64))
    assert solution.solved.tolist() == [True, False]
    assert solution.converged.tolist() == [True, False]
    with pytest.raises(QPError, match="no certified solution"):
        made(dynamics=limited, learn=()).predict([0.95, 3.0])


def test_a_value_of_a_cost_without_curvature_is_that_of_its_plan():
    """With H = 0 no step had a cost, and the first one counted as none: converged, V of an LP."""

    def dynamics(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return x + u, (x[..., 0] + u[..., 0] - 1).abs() + 0.05 * u[..., 0]

    options = {"stage_weight": [0.0, 0.0], "action_bounds": ([-2.0], [2.0]), "gamma": 1.0}
    mpc = QPMPC.of(1, 1, 3, dynamics=dynamics, **options)
    x, cost = torch.tensor([[-3.0], [0.3], [4.0]]).double(), 0.0
    solution: Any = mpc.solve(x)
    for u in solution.plan.unbind(-2):
        x, stage = dynamics(x, u)
        cost = cost + stage
    assert_close(solution.value, cost, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dynamics", [bent, lambda x, u: (bent(x, u), (x**4).sum(-1))])
def test_a_state_of_nan_has_no_plan_and_no_part_in_gradients(dynamics):
    options = {"stage_weight": [1.0, 0.1], "on_failure": "mask", "solver": "daqp"}
    mpc, s = QPMPC.of(1, 1, 5, dynamics=dynamics, **options), torch.tensor([[1.0], [torch.nan]])
    solution, alone = mpc.solve(s.double()), mpc.solve(s[:1].double())
    assert solution.status.tolist() == [Status.SOLVED, Status.INVALID_DATA]
    inputs = [x for x in mpc.parameters() if x.requires_grad]
    found, want = (torch.autograd.grad(x.value[0], inputs) for x in (solution, alone))
    assert_close(found, want)
    physics, state = made(on_failure="mask"), torch.zeros(2, 2).double()
    for own, part, start in ((mpc, mpc, s.double()), (physics, physics.sequential, state)):
        for x in part.parameters():
            x.data.fill_(torch.nan)
        assert own.solve(start).status.tolist() == [Status.INVALID_DATA] * 2
    with pytest.raises(QPError, match="1 INVALID_DATA"):
        QPMPC.of(1, 1, 5, dynamics=dynamics, **{**options, "on_failure": "raise"})(s.double())


def test_actions_satisfy_hard_rows_of_several_actions():
    rows = {"constraints": ([[0.0, 1.0, 1.0]], [-torch.inf], [-3.0]), "solver": "daqp"}
    mpc = QPMPC.of(1, 2, 5, dynamics=bent, stage_weight=[1.0, 0.1, 0.1], **rows)
    s = torch.linspace(-8, 8, 33).double()[:, None]
    assert (mpc.policy(s).sum(-1) <= -3 + 1e-6).all()


def test_a_batch_may_have_its_own_prices_or_no_states():
    bounds = {"action_bounds": ([-1.0], [1.0]), "state_bounds": ([-2.0], [2.0])}
    options = {"stage_weight": [1.0, 0.1], "learn": ("c", "w"), "solver": "daqp"}
    mpc = QPMPC.of(1, 1, 5, dynamics=bent, **bounds, **options)
    s = torch.linspace(-8, 8, 9).double()[:, None]
    own = torch.zeros(9, *mpc.coordinates()["w"].shape).double()  # plans end one after the other
    assert_close(mpc.value(s, mpc.quadratic_program({"w": own})), mpc.value(s), rtol=1e-5, atol=0)
    assert mpc.value(s[:0]).shape == (0,)
    assert mpc.predict(s[:0]).shape == (0, 1)
    layers = [torch.ones(x) for x in ((2, 6), (6,), (2, 3, 3), (2, 1, 3), (6, 2), (2,))]
    model = LearnedModel(torch.zeros(2), torch.ones(2), torch.zeros(6, 2), 1, layers)
    mpc = QPMPC.of(1, 1, 5, dynamics=model, **bounds, **options)
    assert mpc.value(s[:0]).shape == (0,)


def test_a_module_may_have_attributes_of_any_name():
    dynamics: Any = Pendulum()
    dynamics.arguments = {"gravity": 2.0}
    mpc = QPMPC.of(2, 1, 3, dynamics=dynamics, stage_weight=[1.0, 1.0, 0.1])
    mpc.reset_parameters()
    twin: Any = copy.deepcopy(mpc).sequential
    assert twin.dynamics.arguments == {"gravity": 2.0}


def test_q_learning_moves_the_parameters_of_the_dynamics():
    mpc = made(iterations=20, on_failure="mask")
    loss = QPQLearningLoss(QPActorValueOperator(mpc), delay_value=True)
    loss(transitions(8))["loss_value"].backward()
    gradient = mpc.get_parameter("sequential.dynamics.gravity").grad
    assert gradient is not None
    assert gradient != 0
    with pytest.raises(QPError, match=r"rates\[dynamics\]: got -1"):
        mpc.parameter_groups({"cost": 1e-2, "constraints": 1e-3, "dynamics": -1})
    groups = mpc.parameter_groups({"cost": 1e-2, "constraints": 1e-3, "dynamics": 1e-4})
    assert groups[-1]["name"] == "dynamics"
    assert len(groups[-1]["params"]) == 2


def test_copies_pickles_and_states_are_whole():
    mpc = made(iterations=5)
    s = states(mpc)
    with torch.no_grad():
        mpc.get_parameter("sequential.dynamics.gravity").fill_(1.5)
        for twin in (copy.deepcopy(mpc), pickle.loads(pickle.dumps(mpc))):
            assert_close(twin.value(s), mpc.value(s))
        fresh = made(iterations=5)
        fresh.load_state_dict(mpc.state_dict())
        assert_close(fresh.value(s), mpc.value(s))
        assert_close(torch.from_numpy(mpc.predict(s.numpy())), mpc.policy(s))
    with pytest.raises(QPError, match="save: got dynamics, which are code"):
        mpc.save("unused.qpmpc")
    linear = QPMPC.of(
        2, 1, N, A=torch.eye(2), B=torch.ones(2, 1), stage_weight=[1.0] * 3, learn=LEARN
    )
    with pytest.raises(QPError, match="dynamics = 'Pendulum'"):
        linear.load_state_dict(mpc.state_dict())


def test_what_needs_one_model_refuses_dynamics():
    mpc = made()
    calls = [
        lambda: mpc.at_rest(),
        lambda: mpc.model(),
        lambda: predictions(mpc),
        lambda: qm.export_c(mpc, "unused"),
        lambda: largest_difference(mpc, mpc, Polytope.box([-1.0] * 2, [1.0] * 2)),
    ]
    for call in calls:
        with pytest.raises(QPError, match="got one with dynamics, expected one with A and B"):
            call()
    with pytest.raises(QPError, match="residuals: got 'C'"):
        mpc.quadratic_program({"C": torch.zeros_like(mpc.C)})
    with pytest.raises(QPError, match=r"dynamics: got a traced call.* deactivate_vmap=True"):
        torch.func.grad(lambda s: mpc.value(s).sum())(states(mpc))


@refused(
    ({"dynamics": 3}, "dynamics: got 3, expected a function"),
    ({"dynamics": lambda x, u: x[0]}, ".*x\\+ and l of shapes"),
    ({"dynamics": lambda x, u: torch.stack((x[0], x[1]))}, ".*x\\+ and l of shapes"),
    ({"dynamics": lambda x, u: (x + u).detach()}, ".*without a gradient"),
    ({"dynamics": lambda x, u: x[..., 9]}, "dynamics: got IndexError.* Check n_x"),
    ({"dynamics": lambda x, u: (x, u, x)}, "dynamics: got ValueError.* x\\+ or .x\\+, l"),
    ({"dynamics": lambda x, u: (x + u).numpy()}, ".*Can't call numpy.* of float64"),
    ({"dynamics": lambda x, u: nn.Linear(2, 2)(x) + u}, ".*same dtype.*double"),
    ({"dynamics": lambda x, u: x.sqrt() + u}, ".*NaN or inf at the origin"),
    ({"dynamics": lambda x, u: (x, x)}, ".*x\\+ and l of shapes"),
    ({"iterations": 0}, "iterations: got 0"),
    ({"learn": ("C",)}, "learn: got 'C' beside dynamics"),
    ({"action_levels": [[0.0, 1.0]]}, "action_levels: got levels beside dynamics"),
)
def test_invalid_arguments_are_errors(options):
    made(**options)
