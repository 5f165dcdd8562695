"""The step rules against the paper's program, and in updates of either order."""

import copy
import itertools
import sys
from typing import Any

import cvxpy as cp
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.covering import covering
from tests.problems import normal, random_mpc, random_states
from tests.refused import refused
from torch_qpmpc import QPMPC, GaussNewton, QPError, SolverError
from torch_qpmpc.mpc import projections as steps
from torch_qpmpc.mpc.projections import NEAREST, STEPS, nearest_psd, nearest_psd_by_sdp

#: Dense blocks and the paper's diagonal, with learned ``w``.
HESSIANS: dict[str, dict[str, Any]] = {
    "diagonal": {"hessian": "diagonal", "learn": ("H", "H_f", "q", "c", "C", "w")},
    "block": {"hessian": "block", "learn": ("H", "H_f", "q", "c", "C", "w")},
    "tied": {"hessian": "block", "learn": ("H", "H_f", "C", "w"), "structure": "tied"},
}


def symmetric(*shape: int, seed: int = 0) -> Tensor:
    matrix = normal(*shape, seed=seed)
    return (matrix + matrix.mT) / 2


def solve(cost: Any, constraints: list[Any]) -> None:
    options = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-11)
    cp.Problem(cp.Minimize(cost), constraints).solve(cp.CLARABEL, **options)


def hessian_of(mpc: QPMPC, H: Any, H_f: Any) -> Any:
    """Write the QP's undiscounted H in cvxpy, as in the paper."""
    dense = [cp.diag(x) if mpc.hessian == "diagonal" else x for x in (H, H_f)]
    sizes = [mpc.n_x + mpc.n_u] * mpc.horizon + [mpc.n_x]
    blocks = [dense[0]] * mpc.horizon + [dense[1]]
    return cp.bmat(
        [
            [
                block if i == j else torch.zeros(sizes[i], sizes[j]).numpy()
                for j in range(len(sizes))
            ]
            for i, block in enumerate(blocks)
        ]
    )


def papers_step(mpc: QPMPC, rate: float) -> dict[str, Tensor]:
    """Solve eq:sdp1 for the parameters, given their gradients, entry by entry of theta."""
    root = mpc.discount.sqrt()
    parameters = {name: mpc.leaves(name)[0] for name in mpc.learned}
    step = {
        name: cp.Variable(p.shape, symmetric=p.ndim == 2 and name != "C")
        for name, p in parameters.items()
    }
    theta = {name: p.detach().numpy() + step[name] for name, p in parameters.items()}
    # The paper's cost up to a constant: cvxpy 1.7 fails with a separate linear term.
    cost = sum(
        0.5 * cp.sum_squares(step[name] + rate * p.grad.numpy())
        for name, p in parameters.items()
        if p.grad is not None
    )
    H = hessian_of(mpc, theta["H"], theta["H_f"])
    of_qp = cp.multiply(torch.outer(root, root).numpy(), H)
    solve(cost, [of_qp >> 0, theta["w"] >= 0])
    return {name: torch.as_tensor(x.value) for name, x in theta.items()}


@pytest.mark.parametrize("rule", NEAREST)
@pytest.mark.parametrize("name", ["diagonal", "block"])
def test_a_projected_gradient_step_is_the_papers(name, rule):
    rate = 2.0
    mpc = random_mpc(1, horizon=2, step=rule, action_slack=1.0, state_slack=1.0, **HESSIANS[name])
    mpc.value(random_states(4)).sum().backward()
    expected = papers_step(mpc, rate)
    torch.optim.SGD(mpc.parameters(), lr=rate).step()
    proposal = mpc.quadratic_program()
    assert torch.linalg.eigvalsh(proposal.H)[0] < -0.1, "the plain step leaves the cone"
    assert (proposal.w < 0).any()
    mpc.project_()
    for part, value in expected.items():
        assert_close(getattr(mpc, part).detach(), value, rtol=0, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (4, 3, 3), (2, 2, 4, 4)])
def test_the_program_for_a_proposal_is_its_projection(shape):
    H = 10 * symmetric(*shape) if len(shape) > 2 else symmetric(*shape)
    H.view(-1, *shape[-2:])[0] -= 2 * torch.eye(shape[-1])
    by_program = nearest_psd_by_sdp(H)
    assert_close(by_program, nearest_psd(H), rtol=0, atol=1e-6)
    assert (torch.linalg.eigvalsh(by_program) >= 0).all()


@pytest.mark.parametrize("nearest", NEAREST.values())
def test_semidefinite_matrices_are_unchanged_to_the_last_bit(nearest):
    factor = normal(3, 4, 2)
    H = factor @ factor.mT  # of rank two
    H = (H + H.mT) / 2
    assert torch.equal(nearest(H), H)
    H[1] -= 2 * torch.eye(4)
    moved = nearest(H)
    assert torch.equal(moved[[0, 2]], H[[0, 2]])
    assert not torch.equal(moved[1], H[1])
    assert torch.equal(nearest(moved), moved)


@pytest.mark.parametrize("nearest", NEAREST.values())
def test_of_a_matrix_that_is_not_symmetric_the_symmetric_part_counts(nearest):
    H = normal(3, 3)
    assert_close(nearest(H), nearest((H + H.mT) / 2), rtol=0, atol=0)


@pytest.mark.parametrize("nearest", NEAREST.values())
def test_non_finite_qps_go_to_the_solver(nearest):
    H = -torch.eye(2).repeat(2, 1, 1)
    H[0, 0, 0] = torch.nan
    moved = nearest(H)
    assert moved[0].isnan().any()
    assert_close(moved[1], torch.zeros(2, 2), rtol=0, atol=1e-6)


def test_the_gradient_of_a_matrix_is_symmetric():
    """Also for asymmetric losses, such as one entry of H or a function of the solution."""
    mpc = random_mpc(2, step="projection", **HESSIANS["block"])
    (leaf,) = mpc.leaves("H")
    (mpc.H[0, 1] + mpc.policy(random_states(3)).sum()).backward()
    assert leaf.grad is not None
    assert torch.equal(leaf.grad, leaf.grad.mT)
    assert leaf.grad[0, 1] != 0


def test_zero_weights_of_a_diagonal_are_no_part_of_theta():
    """The zeros of diag(theta_1, .., 0, 0) stay zero for every rule; others may grow again."""
    mpc = random_mpc(2, step="projection", stage_weight=[1.0, 0.5, 0.0], free=0.0)
    optimizer = torch.optim.SGD(mpc.parameters(), lr=1.0)
    for sign, expected in ((5.0, [0.0, 0.0, 0.0]), (-1.0, [1.0, 1.0, 0.0])):
        optimizer.zero_grad()
        (sign * mpc.H.sum()).backward()
        optimizer.step()
        mpc.project_()
        assert mpc.H.tolist() == expected


# --- In updates ----------------------------------------------------------------------------------


def make_optimizer(name: str, mpc: QPMPC) -> torch.optim.Optimizer:
    if name == "gauss_newton":
        return GaussNewton(mpc, damping=1e-3)
    kind = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}[name]
    rates = {"adam": (0.05, 5e-3), "sgd": (0.02, 5e-3)}[name]
    return kind(mpc.parameter_groups(dict(zip(("cost", "constraints"), rates, strict=True))))


def learn(mpc: QPMPC, optimizer: torch.optim.Optimizer, target: Tensor, seed: int = 0) -> float:
    """Update towards the costs to go; return the squared errors before."""
    s, a = random_states(len(target), size=0.9, seed=seed), random_states(len(target), 1, size=0.4)
    if isinstance(optimizer, GaussNewton):
        report = optimizer.step(s, a, target)
        return (report.solution.value - target).square().mean().item()
    optimizer.zero_grad()
    loss = (mpc.action_value(s, a) - target).square().mean()
    loss.backward()
    optimizer.step()
    mpc.project_()
    return loss.item()


OPTIMIZERS = ("adam", "sgd", "gauss_newton")


@pytest.mark.parametrize(
    ("rule", "name", "optimizer"), covering(itertools.product(STEPS, HESSIANS, OPTIMIZERS))
)
def test_the_weights_keep_their_sign_while_learning(rule, name, optimizer):
    """Falling targets pull the weights below zero.

    Pairs of rule, form of H and optimizer suffice: the rule applies to each part separately.
    """
    weights = {part for part in ("H", "H_f", "w") if part in HESSIANS[name]["learn"]}
    options = HESSIANS[name] | {"learn": weights, "action_slack": 1.0, "horizon": 2}
    mpc = random_mpc(4, step=rule, **options)
    start = mpc.action_value(random_states(6, size=0.9), random_states(6, 1, size=0.4)).detach()
    moved, lowest = make_optimizer(optimizer, mpc), []
    for update in range(25):
        learn(mpc, moved, start - 0.1 * update, seed=update)
        qp = mpc.quadratic_program()
        eigenvalues = torch.linalg.eigvalsh(qp.H.detach())
        assert_close(qp.H, qp.H.mT, rtol=1e-14, atol=1e-14)
        assert (eigenvalues >= -1e-12 * eigenvalues.abs().max()).all()
        assert (qp.w >= 0).all()
        lowest.append(eigenvalues[0].item())
    assert min(lowest) < 0.05, "they have come to the boundary"


@pytest.mark.parametrize("name", ["diagonal", "block"])
def test_gauss_newton_judges_the_projected_step(name):
    mpc = random_mpc(4, step="projection", hessian=name, learn=("H", "q"))
    s, a = random_states(5, size=0.9), random_states(5, 1, size=0.4)
    old, leaves = mpc.action_value(s, a), list(mpc.parameters())
    of_each = [torch.autograd.grad(value, leaves, retain_graph=True) for value in old]
    rows = torch.stack([torch.cat([part.flatten() for part in parts]) for parts in of_each])

    def theta() -> Tensor:
        return torch.cat([leaf.detach().flatten() for leaf in leaves])

    def squares(change: Tensor) -> float:
        return (old.detach() + change - target).square().sum().item()

    before, target = theta(), old.detach() - 0.5 * normal(5).abs()
    report = GaussNewton(mpc, damping=0.1).step(s, a, target)
    assert report.accepted
    assert torch.linalg.eigvalsh(mpc.quadratic_program().H)[0] < 1e-9, "it was projected"
    start, actual = squares(torch.zeros(5)), mpc.action_value(s, a).detach() - old.detach()
    gain = start - squares(rows @ (theta() - before))
    assert report.ratio == pytest.approx((start - squares(actual)) / gain, rel=1e-6)


def test_the_factor_is_never_projected():
    mpc = random_mpc(5, **HESSIANS["block"])
    with torch.no_grad():
        for leaf in mpc.parameters():
            leaf -= 3.0
    before = copy.deepcopy(mpc.state_dict())
    mpc.project_()
    assert_close(mpc.state_dict(), before, rtol=0, atol=0)


# --- Bad input -----------------------------------------------------------------------------------


def test_the_programs_solver_is_an_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "clarabel", None)
    message = r"step: got 'sdp' without Clarabel, expected Clarabel\. .*'torch-qpmpc\[sdp\]'"
    with pytest.raises(QPError, match=message):
        random_mpc(step="sdp")
    random_mpc(step="projection").project_()


def test_a_program_that_is_not_solved_is_not_silent(monkeypatch):
    monkeypatch.setattr(steps, "TOLERANCE", 1e-30)
    monkeypatch.setattr(steps, "LOOSE", 1e-30)
    with pytest.raises(SolverError, match=r"Clarabel has not solved the program of eq:sdp1: \w+"):
        nearest_psd_by_sdp(symmetric(4, 4))


@refused(
    ("diagonal", torch.tensor([1.0, -2.0, 0.0]), "diagonal: got smallest eigenvalue -2, exp"),
    ("block", -torch.eye(3), "H: got smallest eigenvalue -1, expected a positive semidefinite"),
)
def test_an_indefinite_weight_cannot_be_assigned(hessian, value):
    mpc = random_mpc(step="projection", **HESSIANS[hessian])
    mpc.H = value.double()
