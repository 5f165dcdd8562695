"""Residuals in theta's unconstrained coordinates: values, gradients, vmap, compile, messages."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.func import vmap
from torch.testing import assert_close

from tests.problems import MIXED, central_difference, normal, random_mpc, random_states
from tests.refused import refused
from torch_qpmpc import QPMPC, Status
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST

#: The mixed constraints for a preview of one entry.
MIXED_WITH_PREVIEW: dict[str, Any] = {
    "constraints": ([[0.2, 1.0, 0.5, 1.0]], [-0.8], [0.8]),
    "terminal_constraints": ([[0.1, 1.0, 1.0]], [-0.4], [0.3]),
}
#: Arguments of schemes, each with other coordinates.
KINDS: dict[str, dict[str, Any]] = {
    "free": {},
    "tied": {"structure": "tied", "hessian": "block", **MIXED},
    "preview": {"n_d": 1, "hessian": "block"},
    "tied preview": {"n_d": 1, "structure": "tied", **MIXED_WITH_PREVIEW},
    "projected": {"step": "projection", "hessian": "block"},
}


def make_mpc(kind: str, **options: Any) -> QPMPC:
    """Make a QP with soft actions, so that small residuals leave every QP feasible."""
    settings = {"learn": (*COST, *CONSTRAINTS), "action_slack": 5.0, "free": 0.02}
    return random_mpc(3, **(settings | KINDS[kind] | options))


def functions(mpc: QPMPC, s: Tensor, a: Tensor) -> dict[str, Callable[..., Tensor]]:
    return {
        "value": lambda qp: mpc.value(s, qp),
        "action value": lambda qp: mpc.action_value(s, a, qp),
        "policy": lambda qp: mpc.policy(s, qp=qp),
    }


def residuals_of(mpc: QPMPC, size: float, *batch: int) -> dict[str, Tensor]:
    return {
        name: size * normal(*batch, *x.shape, seed=i)
        for i, (name, x) in enumerate(mpc.coordinates().items())
    }


def inputs(mpc: QPMPC, count: int = 4) -> tuple[Tensor, Tensor]:
    return random_states(count, mpc.n_p, size=0.8), random_states(count, 1, size=0.4)


@pytest.mark.parametrize("kind", KINDS)
def test_zero_residuals_change_no_bit(kind):
    mpc = make_mpc(kind)
    for name, zero in residuals_of(mpc, 0.0, 4).items():
        moved = mpc.quadratic_program({name: zero})
        calls = functions(mpc, *inputs(mpc)).values()
        assert all(torch.equal(f(moved), f(None)) for f in calls), name


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_of_residuals_equals_one_qp_at_a_time(kind):
    mpc = make_mpc(kind, action_slack=50.0)
    s, a = inputs(mpc)
    residuals = residuals_of(mpc, 0.01, 4)
    together = {
        name: f(mpc.quadratic_program(residuals)) for name, f in functions(mpc, s, a).items()
    }
    for i in range(4):
        one = mpc.quadratic_program({name: x[i] for name, x in residuals.items()})
        assert one.batch_shape == ()
        alone = {name: f(one) for name, f in functions(mpc, s[i], a[i]).items()}
        assert_close({name: x[i] for name, x in together.items()}, alone)


@pytest.mark.parametrize("structure", ["free", "tied"])
def test_residuals_are_added_before_the_parametrisations(structure):
    mpc = make_mpc("tied" if structure == "tied" else "free")
    before = {name: x.detach().clone() for name, x in mpc.coordinates().items()}
    residuals = residuals_of(mpc, 0.05)
    expected = mpc.quadratic_program(residuals)
    names = {"A": "C", "B": "C", "D": "G", "D_f": "G"}
    with torch.no_grad():
        for name, coordinate in mpc.coordinates().items():
            assert names.get(name, name) in mpc.learned
            coordinate.add_(residuals[name])
    assert_close(expected.tensors(), mpc.quadratic_program().tensors(), rtol=0, atol=0)
    assert not torch.equal(before["q"], mpc.coordinates()["q"])


@pytest.mark.parametrize("output", ["value", "action value", "policy"])
@pytest.mark.parametrize("kind", ["free", "tied", "preview"])
def test_finite_differences_in_every_residual(kind, output):
    mpc = make_mpc(kind)
    mpc.requires_grad_(False)
    s, a = inputs(mpc, 2)
    weight = normal(2, seed=9) if output != "policy" else normal(2, 1, seed=9)
    start = residuals_of(mpc, 1e-3, 2)

    def total(residuals: dict[str, Tensor]) -> Tensor:
        qp = mpc.quadratic_program(residuals)
        return (weight * functions(mpc, s, a)[output](qp)).sum()

    leaves = {name: x.clone().requires_grad_() for name, x in start.items()}
    total(leaves).backward()
    for i, (name, x) in enumerate(start.items()):
        direction, grad = normal(*x.shape, seed=100 + i), leaves[name].grad
        slope = central_difference(lambda: total(start), x, direction, 1e-5)
        exact = torch.zeros(()).double() if grad is None else (grad * direction).sum()
        assert_close(exact, slope, rtol=1e-4, atol=1e-6, msg=lambda m, name=name: f"{name}: {m}")


def test_entries_outside_the_mask_and_hard_rows_stay():
    mask = torch.zeros(6, 11, dtype=torch.bool)
    mask[0] = True
    mpc = random_mpc(3, learn={"C": mask, "w": True})
    residuals = residuals_of(mpc, 1.0, 4)
    qp = mpc.quadratic_program({name: residuals[name] for name in ("C", "w", "lb")})
    same = qp.C == mpc.C
    assert same[:, ~mask].all()
    assert not same[:, mask].any()
    assert torch.equal(qp.w.isinf(), mpc.quadratic_program().w.isinf().expand(4, -1))
    assert (qp.w >= 0).all()


def test_bounds_that_residuals_cross_are_invalid_data_of_that_qp_alone():
    mpc = random_mpc(3, on_failure="mask")
    residuals = torch.zeros(3, *mpc.lb.shape).double()
    residuals[1, 0] = 10.0
    solution = mpc.solve(torch.zeros(3, 2).double(), qp=mpc.quadratic_program({"lb": residuals}))
    assert solution.status.tolist() == [Status.SOLVED, Status.INVALID_DATA, Status.SOLVED]


@pytest.mark.parametrize("kind", ["free", "tied preview"])
def test_vmap_over_states_and_residuals(kind):
    mpc = make_mpc(kind)
    s, a = inputs(mpc)
    residuals = residuals_of(mpc, 0.01, 4)
    for name in functions(mpc, s, a):

        def one(s: Tensor, a: Tensor, r: dict[str, Tensor], name: str = name) -> Tensor:
            return functions(mpc, s, a)[name](mpc.quadratic_program(r))

        expected = functions(mpc, s, a)[name](mpc.quadratic_program(residuals))
        assert_close(vmap(one)(s, a, residuals), expected)
        first = {name: x[0] for name, x in residuals.items()}
        by_theta = vmap(one, (None, None, 0))(s[0], a[0], residuals)
        assert_close(by_theta[0], one(s[0], a[0], first))


@pytest.mark.usefixtures("fresh_dynamo")
def test_compiled_in_one_graph_equals_eager():
    mpc = make_mpc("tied preview")
    s, a = inputs(mpc)
    leaves = {name: x.requires_grad_() for name, x in residuals_of(mpc, 0.01, 4).items()}

    def run(s: Tensor, a: Tensor, residuals: dict[str, Tensor]) -> Tensor:
        return mpc.action_value(s, a, mpc.quadratic_program(residuals))

    def outcome(function: Callable[..., Tensor]) -> tuple[Tensor, list[Tensor]]:
        out = function(s, a, leaves)
        return out.detach(), list(torch.autograd.grad(out.square().sum(), list(leaves.values())))

    compiled = torch.compile(run, fullgraph=True, backend="eager")
    assert_close(outcome(compiled), outcome(run))


@refused(
    ([0.0], "residuals: got list, expected a Mapping"),
    ({"p": torch.zeros(3)}, "residuals: got 'p', expected names among H, H_f, q, c, C, b"),
    ({"w": torch.zeros(3)}, r"residuals: got 'w', .* Add w to learn\."),
    ({"b": torch.zeros(4, 5)}, r"residuals\['b'\]: got shape \(4, 5\), .*\(\*batch, 6\)"),
    ({"b": torch.zeros(4, 6), "q": torch.zeros(3, 11)}, "batch: got shapes .* that broadcast"),
    ({"H": torch.zeros(4, 3), "H_f": torch.zeros(5, 2)}, "residuals: got batch dim.* that broadca"),
)
def test_residuals_that_do_not_fit(residuals):
    mpc = random_mpc(3, learn=("H", "H_f", "c", "C"))
    mpc.quadratic_program(residuals)
