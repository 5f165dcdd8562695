from dataclasses import FrozenInstanceError, replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from tests.problems import known_qp
from tests.refused import refused
from torch_qpmpc import QPError, QuadraticProgram, Status, solve_qp
from torch_qpmpc.qp.program import EVENT_SHAPES, crossed

GOOD: dict[str, Any] = dict(zip(EVENT_SHAPES, known_qp(0).qp.tensors(), strict=True))


def with_entry(name: str, value: float) -> Any:
    tensor = GOOD[name].clone()
    tensor.view(-1)[0] = value
    return tensor


def with_eigenvalue(lowest: float) -> Any:
    n_z = GOOD["q"].shape[0]
    eigenvalues = torch.ones(n_z, dtype=torch.float64)
    eigenvalues[0] = lowest
    vectors = torch.linalg.eigh(GOOD["H"]).eigenvectors
    H = vectors * eigenvalues @ vectors.mT
    return (H + H.mT) / 2


SHAPE_ERRORS = [
    ({"H": [[1.0]]}, r"H: got list, expected a floating-point torch.Tensor. Convert it"),
    ({"q": torch.ones(12, dtype=torch.int64)}, r"q: got torch.int64, expected a floating-point"),
    ({"b": GOOD["b"].float()}, r"b: got torch.float32, expected H's dtype torch.float64"),
    ({"q": torch.tensor(1.0).double()}, r"q: got shape \(\), expected shape \(\*batch, n_z\)"),
    ({"H": GOOD["H"][:, :-1]}, r"H: got shape \(12, 11\), .* with n_z = 12 as in H"),
    ({"C": GOOD["C"][:, :-1]}, r"C: got shape \(3, 11\), .* with n_z = 12 as in H"),
    ({"b": GOOD["b"][:-1]}, r"b: got shape \(2,\), .* with n_c = 3 as in C"),
    ({"G": GOOD["G"][:-1]}, r"lb: got shape \(13,\), .* with n_g = 12 as in G"),
    ({"w": GOOD["w"][:-1]}, r"w: got shape \(12,\), .* with n_g = 13 as in G"),
    (
        {"q": GOOD["q"].expand(2, -1), "b": GOOD["b"].expand(3, -1)},
        r"batch: got shapes .*'q': \(2, 12\).*, expected leading dimensions that broadcast",
    ),
]
VALUE_ERRORS = [
    *(
        ({name: with_entry(name, bad)}, rf"{name}: got NaN or inf, expected finite entries")
        for name in ("H", "q", "c", "C", "b", "G")
        for bad in (torch.nan, torch.inf)
    ),
    *(({name: with_entry(name, torch.nan)}, f"{name}: got NaN or") for name in ("lb", "ub", "w")),
    ({"lb": with_entry("lb", torch.inf)}, "lb: got NaN or inf, expected numbers or -inf"),
    ({"ub": with_entry("ub", -torch.inf)}, "ub: got NaN or -inf, expected numbers or inf"),
    (
        {"lb": torch.zeros(13).double(), "ub": -2 * torch.ones(13).double()},
        "lb: got lb > ub by up to 2, expected lb <= ub in every row",
    ),
    ({"w": with_entry("w", -1.0)}, "w: got -1, expected non-negative .* Use inf for a hard row"),
    (
        {"H": with_entry("H", 1.0) + GOOD["H"].triu(1)},
        r"H: got asymmetry .* Pass \(H \+ H.mT\) / 2",
    ),
    ({"H": with_eigenvalue(-0.5)}, "H: got smallest eigenvalue -0.5, .* by its Cholesky factor"),
]


@pytest.mark.parametrize(
    ("changes", "message", "check_values"),
    [*((*x, False) for x in SHAPE_ERRORS), *((*x, True) for x in VALUE_ERRORS)],
)
def test_bad_data_is_named(changes, message, check_values):
    """Shapes are checked even where values are not."""
    with pytest.raises(QPError, match=message):
        QuadraticProgram(**(GOOD | changes), check_values=check_values)


@pytest.mark.parametrize(("changes", "message"), VALUE_ERRORS)
def test_values_are_not_checked_on_request(changes, message):
    assert QuadraticProgram(**(GOOD | changes), check_values=False).n_z == 12


def test_one_bad_element_of_a_batch_is_found():
    lb: Any = GOOD["lb"].clone().expand(4, -1).clone()
    lb[2] = GOOD["ub"].clamp(max=9.0) + 1
    with pytest.raises(QPError, match="lb: got lb > ub by up to"):
        QuadraticProgram(**(GOOD | {"lb": lb}))


@pytest.mark.parametrize("lowest", [0.0, -1e-12])
def test_a_singular_hessian_is_accepted_up_to_rounding(lowest):
    QuadraticProgram(**(GOOD | {"H": with_eigenvalue(lowest)}))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounds_that_cross_by_rounding_are_accepted_as_equal(dtype):
    known = known_qp(0, batch=(3,), soft=("equality",), hard=("equality",), dtype=dtype)
    up = torch.nextafter(known.qp.lb, torch.full_like(known.qp.lb, torch.inf))
    solution = solve_qp(replace(known.qp, lb=up), known.fixed, solver="daqp")
    rounding = 1e-4 if dtype == torch.float32 else 1e-9
    assert_close(solution.value, known.value, rtol=rounding, atol=rounding)
    assert not crossed(up, known.qp.ub).any()
    assert crossed(up + 1e-3, known.qp.ub).all()


def test_batch_shape_counts_every_tensor():
    changes = {"c": torch.zeros(3, 1).double(), "q": GOOD["q"].expand(4, -1)}
    assert QuadraticProgram(**(GOOD | changes)).batch_shape == (3, 4)


def test_a_program_cannot_be_changed():
    with pytest.raises(FrozenInstanceError, match="cannot assign"):
        QuadraticProgram(**GOOD).q = GOOD["q"]  # pyright: ignore[reportAttributeAccessIssue] - that


@pytest.mark.parametrize("status", Status)
def test_every_status_explains_itself(status):
    assert len(status.explanation) > 20


def test_a_solution_is_shown_by_its_outcome():
    known = known_qp(0, batch=(5,))
    fixed = known.fixed.clone()
    fixed[2] = torch.nan
    text = repr(solve_qp(known.qp, fixed, on_failure="mask"))
    first, shape, qp, outcome, values, last = text.splitlines()
    assert (first, last) == ("QPSolution(", ")")
    assert shape == f"    batch_shape=(5,), n_f={fixed.shape[-1]},"
    assert qp == f"    qp={known.qp!r},"
    assert outcome == "    solved 4 of 5, 1 INVALID_DATA,"
    value = known.value[[0, 1, 3, 4]]
    assert values.startswith(f"    value from {value.min():.4g} to {value.max():.4g}, residual up")


@pytest.mark.parametrize("lead", [(), (3,)])
def test_absent_parts_are_none(lead):
    H, q, one = torch.eye(2).double(), torch.ones(*lead, 2).double(), torch.ones(2).double()
    G = torch.tensor([[1.0, 1.0]]).double()
    cases = [
        (QuadraticProgram(H, q), [-1.0, -1.0], 0),
        (QuadraticProgram(H, q, lb=-0.5 * one), [-0.5, -0.5], 2),
        (QuadraticProgram(H, q, ub=-2 * one.expand(*lead, 2)), [-2.0, -2.0], 2),
        (QuadraticProgram(H, q, G=G, lb=one[:1]), [0.5, 0.5], 1),
        (QuadraticProgram(H, q, C=G, b=2 * one[:1]), [1.0, 1.0], 0),
    ]
    for qp, z, n_g in cases:
        assert qp.w.shape == (n_g,)
        solution = solve_qp(qp)
        assert_close(solution.z, torch.tensor(z).double().expand(*lead, 2), rtol=0, atol=1e-6)
    with pytest.raises(QPError, match=r"b: got shape \(0,\), .* with n_c = 1 as in C"):
        QuadraticProgram(H, q, C=G)
    with pytest.raises(QPError, match=r"H: got NoneType, expected a floating-point torch\.Tensor"):
        QuadraticProgram(None, q)  # pyright: ignore[reportArgumentType]


@refused(
    ({"H": torch.tensor(1.0)}, r"H: got shape \(\), expected shape \(\*batch, n_z, n_z\)"),
    ({"H": torch.ones(2, 2).int()}, r"H: got torch\.int32, expected a floating-point"),
    ({"G": [[1.0, 0.0]]}, r"G: got list, expected a floating-point torch\.Tensor"),
    ({"G": torch.ones(2)}, r"G: got shape \(2,\), expected shape \(\*batch, n_g, n_z\)"),
    ({"q": None}, r"q: got NoneType, expected a floating-point torch\.Tensor"),
)
def test_invalid_parts_are_named_beside_absent_ones(parts):
    QuadraticProgram(**({"H": torch.eye(2), "q": torch.ones(2)} | parts))
