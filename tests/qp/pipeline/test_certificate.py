from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.problems import KnownQP, certified, known_qp, programs_of, times
from torch_qpmpc import QuadraticProgram, Status
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.refinement import refine
from torch_qpmpc.qp.program import TOLERANCE

BATCH, SPOILT = 5, 2
N_Z, N_C, N_F = 12, 3, 2


class Certificate(NamedTuple):
    value: Tensor
    residual: Tensor
    value_error: Tensor


def certify(p: Programs, *claim: Tensor) -> Certificate:
    return Certificate(*certified(p, *claim))


def judge(known: KnownQP, **claim: Tensor) -> Certificate:
    """Certify the exact solution with the changes in ``claim``."""
    exact = {"z": known.z, "lam": known.lam, "chi": known.chi, "xi": known.xi}
    parts = exact | claim
    return certify(programs_of(known), parts["z"], parts["lam"], parts["chi"], parts["xi"])


def first_row(known: KnownQP, condition: Tensor) -> int:
    """Find the first row of the spoilt element where the condition holds."""
    return int(condition[SPOILT].nonzero()[0, 0])


def shifted(tensor: Tensor, entry: int, by: float) -> Tensor:
    out = tensor.clone()
    out[SPOILT, entry] += by
    return out


@pytest.mark.parametrize(("part", "entry"), [("z", N_Z - 1), ("z", 0), ("chi", 1), ("xi", 1)])
def test_one_wrong_entry_is_rejected_and_only_there(part, entry):
    """Of z, also a fixed one."""
    known = known_qp(1, batch=(BATCH,))
    claim = {part: shifted(getattr(known, part), entry, 1e-3)}
    residual = judge(known, **claim).residual
    assert residual[SPOILT] > 10 * TOLERANCE
    assert residual[torch.arange(BATCH) != SPOILT].max() < 1e-12


def consistent(known: KnownQP, z: Tensor, lam: Tensor, **bounds: Tensor) -> Certificate:
    """Judge z and lam with q and b adapted, so that only the rows can be wrong."""
    H, _, _, C, _, G, lb, ub, _ = known.qp.tensors()
    q = -(times(H, z) + times(G.mT, lam) + times(C.mT, known.chi))
    q[:, :N_F] -= known.xi
    lb, ub = bounds.get("lb", lb), bounds.get("ub", ub)
    changed = replace(
        known, qp=replace(known.qp, q=q, b=times(C, z), lb=lb, ub=ub), fixed=z[:, :N_F]
    )
    return certify(programs_of(changed), z, lam, known.chi, known.xi)


def where(known: KnownQP, kinds: tuple[str, ...], *, hard: bool) -> Tensor:
    qp, y = known.qp, known.z @ known.qp.G.mT
    is_kind = {
        "inside": (known.lam == 0) & qp.lb.isfinite() & qp.ub.isfinite(),
        "at_upper": (known.lam > 0) & (y - qp.ub).abs().lt(1e-9) & (qp.lb < qp.ub),
        "at_lower": (known.lam < 0) & (y - qp.lb).abs().lt(1e-9) & (qp.lb < qp.ub),
        "above": (known.sigma > 0) & (known.lam > 0),
        "no_upper": (known.lam == 0) & qp.lb.isfinite() & qp.ub.isinf(),
    }
    return torch.stack([is_kind[kind] for kind in kinds]).any(0) & (qp.w.isinf() == hard)


@pytest.mark.parametrize(
    ("kind", "hard", "change"),
    [
        ("inside", True, 0.05),  # a multiplier where there is room
        ("at_upper", True, -12.0),  # pulls away from its own bound
        ("at_lower", False, 12.0),
        ("at_upper", False, 12.0),  # at its bound, but more than the slack's weight
        ("above", False, 0.05),  # more than the slack's weight
        ("above", False, -0.05),  # less than it, though violated
        ("no_upper", True, 0.05),  # of a bound that does not exist
        ("no_upper", False, 0.05),
        ("at_upper", True, 0.0),  # of a bound that is not active
        ("at_upper", False, 0.0),
    ],
)
def test_multipliers_that_do_not_fit_their_rows_are_rejected(kind, hard, change):
    known = known_qp(2, batch=(BATCH,))
    row = first_row(known, where(known, (kind,), hard=hard))
    ub = shifted(known.qp.ub, row, 0.0 if change else 1e-3)
    residual = consistent(known, known.z, shifted(known.lam, row, change), ub=ub).residual
    assert residual[SPOILT] > 10 * TOLERANCE
    assert residual[torch.arange(BATCH) != SPOILT].max() < 1e-12


def test_a_violated_hard_row_is_rejected_and_a_soft_one_is_not():
    for hard in (True, False):
        known = known_qp(4, batch=(BATCH,))
        row = first_row(known, where(known, ("inside",), hard=hard))
        y = known.z @ known.qp.G.mT
        ub = known.qp.ub.clone()
        ub[SPOILT, row] = y[SPOILT, row] - 1e-3
        weight = 0.0 if hard else float(known.qp.w[SPOILT, row])
        certificate = consistent(known, known.z, shifted(known.lam, row, weight), ub=ub)
        assert (certificate.residual[SPOILT] > 10 * TOLERANCE) == hard


def unit_programs(q: Tensor, lb: Tensor, ub: Tensor, w: Tensor) -> Programs:
    """Make min 1/2 z'z + q'z over lb <= z <= ub."""
    unit, none = torch.eye(len(q)), torch.zeros(0)
    C = none.reshape(0, len(q))
    return Programs.of(unit, q, none.sum(), C, none, unit, lb, ub, w, none)[0]


@pytest.mark.parametrize("weight", [1.0, torch.inf])
def test_a_multiplier_of_a_bound_that_does_not_exist_is_rejected_at_zero_too(weight):
    z, lam = torch.zeros(1, 1).double(), torch.full((1, 1), 1e-3).double()
    infinite = torch.full((1,), torch.inf)
    programs = unit_programs(-lam[0], -torch.ones(1), infinite, torch.full((1,), weight))
    assert certify(programs, z, lam, z[:, :0], z[:, :0]).residual > 10 * TOLERANCE


def test_complementarity_gaps_of_opposite_sign_do_not_cancel():
    # min 1/2 z'z + q'z with z <= 0: the first row is violated, by less than the tolerance, and
    # the second has room; lam'(ub - z), the summed gap, is zero.
    z = torch.tensor([[5e-7, -5e-7]]).double()
    lam = torch.tensor([[1e3, 1e3]]).double()
    hard = torch.full((2,), torch.inf)
    programs = unit_programs(-(z + lam)[0], -torch.ones(2), torch.zeros(2), hard)
    assert abs((lam * (0 - z)).sum()) < 1e-12
    empty = z[:, :0]
    assert certify(programs, z, lam, empty, empty).residual > 10 * TOLERANCE
    assert certify(programs, 0 * z, lam, empty, empty).residual < TOLERANCE


def test_absurd_multipliers_do_not_hide_errors():
    # min 1/2 z'z - 2 z_2 with z_1 = 0, once in C and once in G: z_2 is 2, not 1.9.
    C, none = torch.tensor([[1.0, 0.0]]), torch.zeros(1)
    q, hard = torch.tensor([0.0, -2.0]), torch.full((1,), torch.inf)
    programs, _ = Programs.of(torch.eye(2), q, none.sum(), C, none, C, none, none, hard, none[:0])
    huge = torch.full((1, 1), 1e12).double()
    for z_2, accepted in ((2.0, True), (1.9, False)):
        z = torch.tensor([[0.0, z_2]]).double()
        _, residual, error = certify(programs, z, huge, -huge, z[:, :0])
        assert bool(residual.maximum(error) <= TOLERANCE) == accepted


def test_the_constant_is_part_of_the_value_but_not_of_the_tolerance():
    known = known_qp(5, batch=(BATCH,))
    lifted = replace(known, qp=replace(known.qp, c=known.qp.c + 1e9))
    claim = {"lam": shifted(known.lam, first_row(known, known.lam == 0), 1e-3)}
    assert_close(judge(lifted).value, known.value + 1e9)
    assert_close(judge(lifted, **claim).residual, judge(known, **claim).residual)


@pytest.mark.parametrize("matrices", [(), (BATCH,)])
@pytest.mark.parametrize("off", [1e-2, 1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("parts", ["z", "lam", "z lam"])
def test_the_error_of_the_value_is_bounded(parts, off, matrices):
    for seed in range(5):
        known = known_qp(seed, batch=(BATCH,), matrices=matrices)
        noise = torch.Generator().manual_seed(seed)
        claim = {
            name: (x := getattr(known, name)) + off * torch.randn(x.shape, generator=noise).double()
            for name in parts.split()
        }
        if "z" in claim:  # on C z = b, as after an elimination
            C, z = known.qp.C, claim["z"]
            z[:, :N_F] = known.fixed
            short = known.qp.b - times(C, z)
            z[:, N_F:] += times(torch.linalg.pinv(C[..., N_F:]), short)
        if "lam" in claim:  # within [-w, w] and at bounds that exist, as `recover` makes it
            lb, ub, w = known.qp.lb, known.qp.ub, known.qp.w
            least, most = torch.where(lb.isinf(), 0, -w), torch.where(ub.isinf(), 0, w)
            claim["lam"] = claim["lam"].clamp(least, most)
        certificate = judge(known, **claim)
        size = largest_term(known, claim.get("z", known.z))
        error = (certificate.value - known.value).abs() / size
        assert (error <= certificate.value_error + 1e-14).all()


def largest_term(known: KnownQP, z: Tensor) -> Tensor:
    H, q, _, _, _, G, lb, ub, w = known.qp.tensors()
    outside = (times(G, z) - times(G, z).clamp(lb, ub)).abs()
    terms = torch.stack(
        (
            (z * times(H, z)).sum(-1) / 2,
            (q * z).sum(-1),
            (w.masked_fill(w.isinf(), 0) * outside).sum(-1),
        )
    )
    return torch.cat((terms, terms.sum(0, keepdim=True))).abs().amax(0)


def test_a_violation_counts_by_the_step_that_ends_it():
    # z_1 = 1 and z_1 - 1e-9 z_2 >= 1 + 1e-9: z_2 is -1. At z_2 = 0 the row is violated by 1e-9.
    C, one = torch.tensor([[1.0, 0.0]]).double(), torch.ones(1).double()
    G, inf = torch.tensor([[1.0, -1e-9]]).double(), torch.full((1,), torch.inf).double()
    data = (torch.eye(2).double(), torch.zeros(2).double(), one.sum(), C, one, G, one + 1e-9)
    programs, _ = Programs.of(*data, inf, inf, one[:0])
    z = torch.tensor([[1.0, 0.0]]).double()
    certificate = certify(programs, z, 0 * z[:, :1], -z[:, :1], z[:, :0])
    assert certificate.residual <= TOLERANCE
    assert certificate.value_error > 1


def bounded_by_both(least: float, noise: float = 0.0) -> Certificate:
    """Judge v = 2 of an input 52.5 + v in [least, 80] whose move v is at most 2."""
    data: dict[str, Any] = {"H": torch.eye(2), "q": [0.0, -3.0]}
    data |= {"G": [[1.0, 1.0], [0.0, 1.0]], "lb": [least, -2.0], "ub": [80.0, 2.0]}
    parts: Any = {name: torch.as_tensor(x, dtype=torch.float64) for name, x in data.items()}
    z, lam = torch.tensor([[52.5, 2.0]]).double(), torch.tensor([[noise, 1.0]]).double()
    p, _ = Programs.of(*QuadraticProgram(**parts).tensors(), z[:, :1])
    return certify(p, z, lam, z[:, :0], -z[:, :1])


@pytest.mark.parametrize("noise", [0.0, 3e-14, -3e-14])
@pytest.mark.parametrize("least", [20.0, 54.5])
def test_rows_that_agree_up_to_the_rounding_of_the_larger_bound_the_error(least, noise):
    """The first row, of terms 25 times as large, counted as contradicting the second.

    At 54.5, the two hold v between them; at 20, rounding alone gives the first a multiplier.
    """
    certificate = bounded_by_both(least, noise)
    assert certificate.residual.item() < 1e-9
    assert certificate.value_error.item() < 1e-9


def test_rows_that_disagree_leave_the_error_without_a_bound():
    assert bounded_by_both(54.5 + 1e-11).value_error.item() == torch.inf


@pytest.mark.parametrize(("noise", "bounded"), [(1e-12, True), (1e-9, False)])
def test_rows_that_agree_up_to_the_rounding_of_a_thin_angle_bound_the_error(noise, bounded):
    """Two rows at an angle of 1e-3 fix a vertex to a thousand times their own rounding."""
    one, none = torch.eye(2).double(), torch.zeros(2).double()
    G = torch.tensor([[1.0, 0.0], [1.0, 1e-3], [0.6, 0.8]]).double()
    ub, inf = G.sum(1), torch.full((3,), torch.inf).double()
    ub[2] -= noise
    lam = torch.tensor([[0.0, 0.0, 1.0]]).double()
    data = (one, -1 - G[2], none[0], one[:0], none[:0], G, -inf, ub, inf, none[:0])
    z, nothing = torch.ones(1, 2).double(), torch.zeros(1, 0).double()
    certificate = certify(Programs.of(*data)[0], z, lam, nothing, nothing)
    assert (certificate.value_error.item() < 1e-6) == bounded


# Each judge of the same rows


def vector(*entries: float) -> Tensor:
    return torch.tensor(entries, dtype=torch.float64)


#: Violations relative to the terms of the row, and whether they are too large.
VIOLATIONS = [(3e-8, True), (3e-5, False)]


@pytest.mark.parametrize(("off", "right"), VIOLATIONS)
@pytest.mark.parametrize("low", [-torch.inf, -1e6, -1e19])
@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
def test_the_certificate_judges_rows_of_all_lengths_alike(low, length, off, right):
    """Of z_1 <= 0.5 beside z_2 <= 1e6, both in lengths, a solution is beyond its bound."""
    one, lb = torch.eye(2).double(), torch.full((2,), low).double()
    G, ub = torch.diag(vector(length, 1.0)), vector(0.5 * length, 1e6)
    qp = QuadraticProgram(one, vector(-1.0, 0.0), G=G, lb=lb, ub=ub)
    z = vector(0.5 * (1 + off), 0.0)[None]
    lam = (1 - z) / length * one[:1]
    plain = Programs.of(*qp.tensors(), z[:, :0])[0]
    programs, units = plain.scaled(), plain.prepared.units
    if units is not None:
        z, lam = z / torch.as_tensor(units.length), lam * torch.as_tensor(units.rows / units.cost)
    claim = z, lam, z[:, :0], z[:, :0]
    assert (certified(programs, *claim)[1][0] <= TOLERANCE) == right


@pytest.mark.parametrize(("off", "right"), VIOLATIONS)
@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
def test_a_refinement_judges_opposed_rows_alike(length, off, right):
    """Of z_1 <= 0.5 and z_1 >= 0.5 (1 + off), a solution is between the two."""
    one, none, inf = torch.eye(1).double(), torch.zeros(0).double(), torch.full((2,), torch.inf)
    G, middle = length * torch.ones(2, 1).double(), 0.5 * length
    lb, ub = vector(-torch.inf, middle * (1 + off)), vector(middle, torch.inf)
    data = (one, vector(-1.0), one[0, 0], one[:0], none, G, lb, ub, inf, none)
    programs = Programs.of(*data)[0]
    z, lam = np.full((1, 1), 0.5), np.array([[1.0, -0.5]]) / length
    near = programs.unsolved(Status.NOT_CONVERGED)._replace(z=z, lam=lam, active=np.sign(lam))
    refine(programs, near, np.arange(1))
    assert (near.status[0] == Status.SOLVED) == right
