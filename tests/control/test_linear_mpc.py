"""`LinearMPC` beside the same problem in CVXPY, its set-points, and messages."""

from types import SimpleNamespace

import cvxpy
import numpy as np
import pandas as pd
import pytest
import torch

import torch_qpmpc as qm
from tests.refused import refused
from torch_qpmpc.control.lowering import riccati

A = np.array([[0.9, 0.2, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [0.5, 0.0], [0.0, 0.4]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
E = np.array([[0.1, 0.0], [0.0, 0.0], [0.2, 0.0]])  # the second signal is a price
NAMES = {"inputs": ["q", "v"], "outputs": ["T", "c"], "known": ["T_out", "price"]}
DESIGN = {
    "Q": {"T": 2.0, "c": 1.0},
    "R": {"q": 0.3},
    "dR": {"q": 0.5, "v": 0.2},
    "y_bounds": {"T": (None, 1.2)},
    "u_bounds": (-1.0, 1.0),
    "du_bounds": {"v": (-0.3, 0.3)},
    "y_slack": 20.0,
    "linear": {"q": "price", "v": 0.05},
}
SCALAR = ([[0.9]], [[0.5]])


def reference(x, targets, known, u_last, held=(), N=8):
    """Solve the problem as its docstring has it, with the steady state of each stage's signals."""
    plan = cvxpy.Variable((N, 2))
    rows: list[cvxpy.Constraint] = [plan >= -1, plan <= 1]
    rows += [plan[k] == plan[k - 1] for k in held]
    target = targets[-1]
    cost, last, load = 0, u_last, target.y - C @ target.x
    for k in range(N + 1):
        y = C @ x + load
        cost += 20 * cvxpy.pos(y[0] - 1.2)
        if k == N:
            error = cvxpy.hstack((x - target.x, last - target.u))
            cost += cvxpy.quad_form(error, terminal_weight())
            cvxpy.Problem(cvxpy.Minimize(cost), rows).solve(
                solver="CLARABEL", tol_gap_rel=1e-11, tol_feas=1e-11
            )
            return plan.value[0]
        du = plan[k] - last
        cost += 2 * cvxpy.square(y[0] - targets[k].y[0]) + cvxpy.square(y[1] - targets[k].y[1])
        cost += 0.3 * cvxpy.square(plan[k, 0] - targets[k].u[0])
        cost += 0.5 * cvxpy.square(du[0]) + 0.2 * cvxpy.square(du[1])
        cost += known[k][1] * plan[k, 0] + 0.05 * plan[k, 1]
        rows += [cvxpy.abs(du[1]) <= 0.3]
        x, last = A @ x + B @ plan[k] + E @ known[k], plan[k]
    raise AssertionError


def terminal_weight():
    """Iterate the Riccati equation of (x, u_last) to its limit."""
    F = np.block([[A, np.zeros((3, 2))], [np.zeros((2, 5))]])
    G = np.vstack((B, np.eye(2)))
    dR, R = np.diag([0.5, 0.2]), np.diag([0.8, 0.2])
    Q = np.block([[C.T @ np.diag([2.0, 1.0]) @ C, np.zeros((3, 2))], [np.zeros((2, 3)), dR]])
    S = np.vstack((np.zeros((3, 2)), -dR))
    P = Q
    for _ in range(2000):
        K = np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F + S.T)
        P = Q + F.T @ P @ F - (F.T @ P @ G + S) @ K
    return P


def steady_state(r, w, d):
    """The target within wide bounds: y = C x + w is r."""
    matrix = np.block([[A - np.eye(3), B], [C, np.zeros((2, 2))]])
    state = np.linalg.solve(matrix, np.concatenate((-E @ d, r - w)))
    return SimpleNamespace(x=state[:3], u=state[3:], y=r)


@pytest.mark.parametrize(("blocks", "held"), [([], []), ([1, 2, 5], [2, 4, 5, 6, 7])])
@pytest.mark.parametrize("references", ["held", "preview"])
def test_the_plan_is_that_of_the_problem_in_the_docstring(references, blocks, held):
    wide = {**DESIGN, "u_bounds": (-1.0, 1.0)}
    options = {**NAMES, **wide, "references": references, "blocks": blocks}
    mpc = qm.LinearMPC((A, B, C), 8, E=E, **options)
    rng = np.random.default_rng(0)
    for _ in range(2):
        x, w, u_last = rng.normal(size=3), 0.1 * rng.normal(size=2), rng.uniform(-0.8, 0.8, 2)
        r = 0.1 * rng.normal(size=(9, 2))
        r = r if references == "preview" else r[:1].repeat(9, 0)
        known = 0.1 * rng.normal(size=(9, 2))
        expected = [steady_state(r[k], w, known[k]) for k in range(9)]
        target = mpc.target(r, w, known)
        assert np.allclose(target.u, [one.u for one in expected], atol=1e-8)
        u = reference(x, expected, known, u_last, held)
        p = mpc.arrange(x, target, known=known, u_last=u_last)
        assert np.allclose(target.u[-1] + mpc.plan.policy(p).detach(), u, atol=1e-5)


def test_without_a_riccati_solution_the_terminal_weight_is_the_stage_s():
    # The position has no weight and does not decay.
    mpc = qm.LinearMPC(([[1.0, 0.1], [0.0, 0.9]], [[0.0], [1.0]]), 3, Q=[0.0, 1.0], R=1.0)
    squares = torch.zeros(4, 4).double()
    squares[[1, 1, 2, 2], [1, 2, 1, 2]] = 2.0  # of the speed's deviation and of y_s - r
    assert torch.equal(mpc.plan.H_f.detach()[:4, :4], squares)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_rounding_does_not_decide_on_a_riccati_solution_without_a_cost(unit):
    """Two inputs hold one output, a double integrator has no weight of its position."""
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(2, 2)))[0]
    A = basis @ [[1.0, 1.0], [0.0, 1.0]] @ basis.T
    B, C, q = basis @ [[0.5], [1.0]], unit * basis.T, unit**-2
    for model, Q in ((([[0.9]], [[0.5, 0.4]], [[unit]]), q), ((A, B, C), [0.0, q])):
        assert riccati(qm.LinearMPC(model, 3, Q=Q, dR=0.1).design) is None
        assert riccati(qm.LinearMPC(model, 3, Q=Q, dR=0.1, gamma=0.9).design) is not None
    assert riccati(qm.LinearMPC((A, B, C), 3, Q=[q, 0.0], dR=0.1).design) is not None


def test_an_mpc_has_a_plan_and_is_none():
    """`QPMPC.of` and others were inherited, and failed."""
    mpc = qm.LinearMPC(SCALAR, 3, Q=1.0, dR=0.1, learn=("H",))
    assert not {"of", "from_model", "from_data", "policy"} & {*dir(mpc)}
    assert mpc.plan.scheme.constants == {mpc.plan.n_p - 1: 1.0}
    assert mpc.options["learn"] == {"H": True}
    assert repr(mpc) == "LinearMPC(y1 by u1; horizon 3; Q [1.0]; dR [0.1]; learned H)"


def test_p_takes_batches_and_is_relative_to_the_last_target():
    mpc = qm.LinearMPC((A, B, C), 8, E=E, references="preview", **NAMES, **DESIGN)
    r = np.linspace(0, 0.1, 9)[:, None] * np.ones((5, 1, 2))
    p = mpc.arrange(np.ones((5, 3)), mpc.target(r), known=np.ones((5, 9, 2)))
    assert tuple(p.shape) == (5, mpc.plan.n_p)
    assert np.allclose(p[0, :2], -0.1)  # r_0 - r_N
    assert p[0, 4:6].tolist() == [0, 1], "a load is relative to its last row"
    assert p[0, 48 : 48 + 4].abs().max() < 1e-12


def test_a_side_of_bounds_may_be_none():
    model, inf = (np.diag([0.9, 0.8]), np.eye(2)), np.inf
    cases = {
        (None, 3.0): [[-inf, -inf], [3.0, 3.0]],
        ((None, -1.0), None): [[-inf, -1.0], [inf, inf]],
    }
    for bounds, sides in cases.items():
        design = qm.LinearMPC(model, 3, Q=1.0, u_bounds=bounds).design
        assert [side.tolist() for side in design.u_bounds] == sides


@pytest.mark.parametrize("read", [tuple, np.array, np.float32, torch.tensor, pd.Series])
def test_pairs_of_bounds_and_prices_are_of_any_numbers(read):
    pair, price = read([-1.0, 1.0]), np.float32(0.5)
    options = {"constraints": {"power": ({"u1": 1.0}, pair, price)}, "linear": {"u1": price}}
    for bounds in (pair, {"u1": pair}):
        design = qm.LinearMPC(SCALAR, 3, Q=1.0, u_bounds=bounds, **options).design
        assert [side.tolist() for side in design.u_bounds] == [[-1.0], [1.0]]
        assert design.constraints["power"] == ({"u1": 1.0}, (-1.0, 1.0), 0.5)
        assert design.linear == {"u1": 0.5}


@refused(
    ({"Q": None}, "Q: got no cost, expected weights .* Pass one, such as Q={'y1': 1.0}, dR="),
    ({"Q": {"T": 1.0}}, "Q: got 'T', expected names among y1"),
    ({"Q": [1.0, 2.0]}, r"Q: got shape \(2,\), expected a number, or one for each of"),
    ({"linear": {"u1": "d1"}, "E": [[1.0]]}, "linear: got 'd1', which acts on the plant"),
    ({"Q": [[1.0, 2.0]]}, r"Q: got shape \(1, 2\), expected \(1, 1\)"),
    ({"dR": -1.0}, "dR: got smallest eigenvalue -1, expected a positive semidefinite weight"),
    ({"horizon": 0}, "horizon: got 0, expected a whole number >= 1"),
    ({"blocks": [1, 1]}, r"blocks: got \[1, 1\], expected whole numbers .* the horizon 3"),
    ({"blocks": 3}, "blocks: got 3, expected whole numbers"),
    ({"references": "later"}, "references: got 'later', expected one of held, preview"),
    ({"gamma": 0}, "gamma: got 0, expected a discount factor"),
    ({"y_slack": -1.0}, "y_slack: got {'y1': -1.0}, expected prices >= 0"),
    ({"linear": 1.0}, "linear: got 1.0, expected a mapping from inputs"),
    ({"linear": {"u1": "price"}}, "linear: got {'u1': 'price'}, .* Pass known=.'price'"),
    ({"u_bounds": {"q": (0, 1)}}, "u_bounds: got 'q', expected names among u1"),
    ({"u_bounds": {"u1": 1.0}}, "u_bounds: got {'u1': 1.0}, expected pairs .* by name"),
    ({"u_bounds": 1.0}, "u_bounds: got 1.0, expected the pair"),
    ({"du_bounds": (0.1, 0.3)}, r"du_bounds: got \(0.1, 0.3\) for u1, expected zero between"),
    ({"u_bounds": (1.0, 0.0)}, r"u_bounds: got \(1, 0\) for u1, expected lower <="),
    ({"u_bounds": (np.inf, None)}, r"u_bounds: got \(inf, inf\) for u1, expected .* for no bound"),
    ({"y_bounds": (None, -np.inf)}, r"y_bounds: got \(-inf, -inf\) for y1, expected .* for no "),
)
def test_bad_arguments_are_named(arguments):
    qm.LinearMPC(SCALAR, **{"horizon": 3, "Q": 1.0, **arguments})


@refused(
    ({"x": [1.0, 2.0]}, r"x: got shape \(2,\), expected 1 entries"),
    ({"known": np.ones((3, 2))}, "known: .* expected 0 entries"),
    ({"target": [1.0, 2.0]}, r"r: got shape \(2,\), expected 1 entries"),
)
def test_signals_that_are_not_those_of_p_are_named(arguments):
    mpc = qm.LinearMPC(SCALAR, 3, Q=1.0)
    signals = {"x": [1.0], **arguments}
    mpc.arrange(**{**signals, "target": mpc.target(signals.get("target", [0.0]))})


@pytest.mark.parametrize("inputs", [1, 2])
def test_the_target_has_a_gradient(inputs):
    B = [[0.5, 0.4][:inputs]]
    mpc = qm.LinearMPC(([[0.9]], B), 5, Q=1.0, R=0.1, u_bounds=(-1.0, 1.0), E=[[0.2]], known=["d"])
    point = [torch.tensor([x], dtype=torch.float64, requires_grad=True) for x in (1.0, 0.3, -0.2)]
    assert torch.autograd.gradcheck(lambda *point: tuple(mpc.target(*point)), point)
    out_of_reach = torch.tensor([90.0], dtype=torch.float64, requires_grad=True)
    mpc.target(out_of_reach).y.sum().backward()
    assert out_of_reach.grad.abs().max() < 1e-9
    assert not mpc.target([1.0]).u.requires_grad


@pytest.mark.parametrize("far", [1e8, 1e14, 1e20])
@pytest.mark.parametrize("side", ["y_bounds", "u_bounds", "both"])
def test_bounds_that_cannot_act_change_neither_weight_nor_input(side, far):
    """A large number in place of an infinite bound once cost the Riccati weight."""
    names = ("y_bounds", "u_bounds") if side == "both" else (side,)
    plain, bounded = (
        qm.Controller(qm.LinearMPC(SCALAR, 8, Q=1.0, dR=0.1, **dict.fromkeys(names, (-x, x))))
        for x in (np.inf, far)
    )
    assert riccati(bounded.mpc.design) is not None
    for controller in (plain, bounded):
        controller.reset(y=[0.0], u=[0.0])
    for y in (0.0, 0.3, 0.5):
        inputs = (controller.step([y], r=[1.0]) for controller in (plain, bounded))
        np.testing.assert_allclose(*inputs, rtol=1e-6)


def test_outputs_in_any_units_have_a_symmetric_weight():
    rng, unit = np.random.default_rng(3), 10 ** np.array([-5.0, 0.0, 5.0])
    A, B, C = 0.5 * np.eye(4), rng.normal(size=(4, 2)), unit[:, None] * rng.normal(size=(3, 4))
    mpc = qm.LinearMPC((A, B, C), 12, Q=np.diag(1 / unit**2), dR=0.1, u_bounds=(-1, 1))
    H = mpc.plan.quadratic_program().H
    assert torch.equal(H, H.mT)
