"""Families of QPs with known outcomes: a solution built from a KKT point, or a reason for none.

A family is a function of a `Draw` and a count. It returns a `Case`, a batch of that size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import torch
from torch import Tensor

from tests.campaign import prefix
from tests.campaign.draws import FLOAT32, Case, Draw, changed, solvable
from tests.campaign.trained import trained
from tests.problems import BRINK, HARD_ROWS, SOFT_ROWS, WEAK, KnownQP, times
from torch_qpmpc import QuadraticProgram, Status
from torch_qpmpc.mpc.layout import banded_matrix


def well_posed(draw: Draw, count: int) -> Case:
    return solvable(draw.known(count))


def degenerate(draw: Draw, count: int) -> Case:
    kinds = ("at_lower", "at_upper", "equality")
    hard, soft = draw.rows(kinds, 10, 20), draw.rows((*kinds, "above", "below"), 0, 8)
    return solvable(draw.known(count, hard=hard, soft=soft))


def weakly_active(draw: Draw, count: int) -> Case:
    soft, hard = draw.rows((*WEAK, *SOFT_ROWS), 1, 8), draw.rows((*WEAK, "at_upper"), 1, 6)
    return solvable(draw.known(count, soft=(*soft, WEAK[0]), hard=hard))


def exact_penalty_threshold(draw: Draw, count: int) -> Case:
    """Rows with multiplier w and zero slack."""
    soft = draw.rows((*BRINK, "above", "inside"), 1, 8)
    return solvable(draw.known(count, soft=(*soft, BRINK[0])))


def dependent_rows(draw: Draw, count: int) -> Case:
    """Rows of G that repeat each other and the rows of C."""
    n_z, n_c, n_f = 10, 3, draw.randint(0, 2)
    C, few = draw.normal(n_c, n_z), draw.normal(3, n_z)
    soft, hard = draw.rows(SOFT_ROWS, 2, 8), draw.rows(HARD_ROWS, 2, 8)
    G = draw.combinations(torch.cat((few, C)), len(soft) + len(hard))
    return solvable(draw.known(count, n_z=n_z, n_f=n_f, C=C, G=G, soft=soft, hard=hard))


def rank_deficient_C(draw: Draw, count: int) -> Case:
    n_z = 10
    C = draw.combinations(draw.normal(draw.randint(1, 3), n_z), draw.randint(4, 6))
    return solvable(draw.known(count, n_z=n_z, n_f=draw.randint(0, 2), C=C, matrices=()))


def inconsistent_C(draw: Draw, count: int) -> Case:
    """Equalities that contradict each other."""
    case = rank_deficient_C(draw, count)
    left = torch.linalg.svd(case.known.qp.C)[0][:, -1]
    off = left * draw.powers(-3, 2, count, 1) * (1 + case.known.qp.b.abs().amax(-1, keepdim=True))
    known = changed(case.known, b=case.known.qp.b + off)
    return Case(known, torch.full_like(case.expected, int(Status.INFEASIBLE)))


def singular_H(draw: Draw, count: int) -> Case:
    return solvable(draw.known(count, rank=draw.randint(1, 3)))


def zero_H(draw: Draw, count: int) -> Case:
    return solvable(draw.known(count, rank=0))


def ill_conditioned_H(draw: Draw, count: int) -> Case:
    n_z = draw.randint(3, 14)
    basis = torch.linalg.qr(draw.normal(n_z, n_z))[0]
    spectrum = torch.logspace(-12, 0, n_z, dtype=torch.float64)
    H = basis @ torch.diag(spectrum * draw.powers(0, 3)) @ basis.mT
    return solvable(draw.known(count, n_z=n_z, n_f=0, n_c=0, H=(H + H.mT) / 2))


def slack_weights(draw: Draw, count: int) -> Case:
    soft = draw.rows(SOFT_ROWS, 2, 8)
    return solvable(draw.known(count, soft=soft, weight=10 ** draw.uniform(-3, 6)))


def absent_and_equal_bounds(draw: Draw, count: int) -> Case:
    kinds = ("free", "no_upper", "equality")
    return solvable(draw.known(count, soft=draw.rows(kinds, 1, 8), hard=draw.rows(kinds, 0, 3)))


def crossing_bounds(draw: Draw, count: int) -> Case:
    known = draw.known(count, soft=("equality", "above"), hard=("equality",))
    lb, ub = known.qp.lb, known.qp.ub
    up = torch.nextafter(lb, torch.full_like(lb, torch.inf))
    return solvable(changed(known, lb=torch.where(lb == ub, up, lb)))


def infeasible(draw: Draw, count: int) -> Case:
    known = draw.known(count, matrices=(count,), soft=draw.rows(SOFT_ROWS, 0, 8), hard=("inside",))
    return contradicted(draw, widened(known), torch.ones(count, dtype=torch.bool))


def unbounded(draw: Draw, count: int) -> Case:
    return falling(draw, widened(draw.known(count, matrices=(count,), n_z=8, n_c=2, n_f=2)), all)


def mixed(draw: Draw, count: int) -> Case:
    """Good QPs beside infeasible, unbounded and invalid ones."""
    known = widened(draw.known(count, matrices=(count,), n_z=8, n_c=2, n_f=2))
    lot = torch.tensor([draw.randrange(5) for _ in range(count)], dtype=torch.int64)
    case = contradicted(draw, known, lot == 2)
    case = falling(draw, case.known, lambda _: lot == 3, case.expected)
    spoilt = dict(vars(case.known.qp))
    name = draw.choice(["H", "q", "C", "b", "G", "w"])
    tensor = spoilt[name].clone()
    tensor[lot == 4] = torch.nan
    expected = case.expected.masked_fill(lot == 4, int(Status.INVALID_DATA))
    return Case(changed(case.known, **{name: tensor}), expected)


def widened(known: KnownQP) -> KnownQP:
    """Add four rows without bounds, which a family then makes infeasible or unbounded."""
    qp, more = known.qp, 4
    batch = known.value.shape
    G = torch.cat((qp.G.new_ones(*qp.G.shape[:-2], more, qp.n_z), qp.G), dim=-2)
    none, w = qp.lb.new_full((*batch, more), torch.inf), qp.w.new_ones(*batch, more)
    padded = {
        "lam": torch.cat((0 * w, known.lam), -1),
        "sigma": torch.cat((0 * w, known.sigma), -1),
    }
    wide = changed(
        known,
        G=G,
        lb=torch.cat((-none, qp.lb), -1),
        ub=torch.cat((none, qp.ub), -1),
        w=torch.cat((w, qp.w), -1),
    )
    return replace(wide, **padded)


def contradicted(draw: Draw, known: KnownQP, at: Tensor) -> Case:
    """Contradict rows by Farkas' lemma where ``at``: a positive combination, with C's, gives 0 < 0.

    lam > 0 and chi with ``G'lam + C'chi = 0`` off the fixed entries, and ``lam'ub + chi'b`` below
    what those give.
    """
    qp, n_f, k = known.qp, known.fixed.shape[-1], draw.randint(2, 4)
    n, count = qp.n_z, len(at)
    rows, lam = draw.normal(count, k, n), draw.powers(-1, 1, count, k)
    chi = draw.normal(count, qp.C.shape[-2]) * draw.choice([0.0, 1.0])
    pull = times(rows[:, :-1].mT, lam[:, :-1]) + times(qp.C.mT, chi)
    rows[:, -1] = -pull / lam[:, -1:]
    rows[:, -1, :n_f] = draw.normal(n_f)
    y = times(rows, known.z)
    upper = y + draw.normal(count, k)
    given = ((pull + lam[:, -1:] * rows[:, -1])[:, :n_f] * known.fixed).sum(-1)
    demand = given - (chi * qp.b).sum(-1) - (lam[:, :-1] * upper[:, :-1]).sum(-1)
    margin = draw.powers(-3, 1, count) * (1 + upper.abs().amax(-1))
    upper[:, -1] = demand / lam[:, -1] - margin
    G, ub, w = qp.G.clone(), qp.ub.clone(), qp.w.clone()
    G[at, :k], ub[at, :k], w[at, :k] = rows[at], upper[at], torch.inf
    status = torch.where(at, int(Status.INFEASIBLE), int(Status.SOLVED))
    return Case(changed(known, G=G, ub=ub, w=w), status)


def falling(
    draw: Draw, known: KnownQP, choose: Callable[..., Any], expected: Tensor | None = None
) -> Case:
    """Make the cost fall along a direction without curvature that C and the hard rows allow."""
    qp, n_f = known.qp, known.fixed.shape[-1]
    at = torch.ones(known.value.shape, dtype=torch.bool) if choose is all else choose(known)
    null = torch.linalg.svd(qp.C[..., n_f:], full_matrices=True)[2][..., -1, :]
    d = torch.cat((null.new_zeros(*null.shape[:-1], n_f), null), -1)
    P = torch.eye(qp.n_z).double() - d.unsqueeze(-1) * d.unsqueeze(-2)
    hard = qp.w.isinf()
    G = torch.where(hard.unsqueeze(-1), qp.G @ P, qp.G)
    if draw.random() < 0.5:  # rows with a bound on the other side only hinder nothing
        open_row = qp.G[:, 0].clone() - 0.1 * d
        G[:, 0] = open_row
    shift = times(G - qp.G, known.z)
    charge = torch.where(hard, 0, qp.w * times(G, d).abs()).nan_to_num(0, 0, 0).sum(-1)
    force = charge + draw.powers(-2, 1, *at.shape) * (1 + qp.q.abs().amax(-1))
    q = qp.q - ((qp.q * d).sum(-1) + force).unsqueeze(-1) * d
    moved = {
        "H": (P @ qp.H @ P + (P @ qp.H @ P).mT) / 2,
        "q": q,
        "G": G,
        "lb": qp.lb + shift,
        "ub": qp.ub + shift,
    }
    where = {
        name: torch.where(at.reshape(-1, *(1,) * (new.ndim - 1)), new, getattr(qp, name))
        for name, new in moved.items()
    }
    if expected is None:
        expected = torch.full(at.shape, int(Status.SOLVED))
    return Case(changed(known, **where), expected.masked_fill(at, int(Status.UNBOUNDED)))


def in_units(
    known: KnownQP, cost: Tensor, variables: Tensor, rows: Tensor, equalities: Tensor
) -> KnownQP:
    """Convert a QP to other units, one per matrix triple: ``()`` or ``(B,)``."""
    qp = known.qp

    def of(factor: Tensor, tensor: Tensor, ndim: int) -> Tensor:
        return factor.reshape(*factor.shape, *(1,) * ndim) * tensor

    scaled = changed(
        known,
        H=of(cost / variables**2, qp.H, 2),
        q=of(cost / variables, qp.q, 1),
        c=cost * qp.c,
        C=of(equalities / variables, qp.C, 2),
        b=of(equalities, qp.b, 1),
        G=of(rows / variables, qp.G, 2),
        lb=of(rows, qp.lb, 1),
        ub=of(rows, qp.ub, 1),
        w=of(cost / rows, qp.w, 1),
    )
    return replace(
        scaled,
        fixed=of(variables, known.fixed, 1),
        value=cost * known.value,
        z=of(variables, known.z, 1),
        sigma=of(rows, known.sigma, 1),
        chi=of(cost / equalities, known.chi, 1),
        lam=of(cost / rows, known.lam, 1),
        xi=of(cost / variables, known.xi, 1),
    )


def scaled(draw: Draw, count: int, *which: str, most: float = 8.0) -> Case:
    known = draw.known(count)
    shape = known.qp.H.shape[:-2]
    names = ("cost", "variables", "rows", "equalities")
    units = {
        name: draw.powers(-most, most, *shape) if name in which else torch.ones(shape).double()
        for name in names
    }
    return solvable(in_units(known, **units))


def scaled_cost(draw: Draw, count: int) -> Case:
    return scaled(draw, count, "cost")


def scaled_variables(draw: Draw, count: int) -> Case:
    return scaled(draw, count, "variables")


def scaled_constraints(draw: Draw, count: int) -> Case:
    return scaled(draw, count, "rows", "equalities")


def scaled_everything(draw: Draw, count: int) -> Case:
    return scaled(draw, count, "cost", "variables", "rows", "equalities", most=4.0)


def scaled_mixed(draw: Draw, count: int) -> Case:
    case = mixed(draw, count)
    units = {name: draw.powers(-4, 4, count) for name in ("cost", "variables", "rows")}
    known = in_units(case.known, **units, equalities=draw.powers(-8, 8, count))
    return replace(case, known=known)


def scaled_entries(draw: Draw, count: int) -> Case:
    """Entries of z in units of their own, from 1e-6 to 1e6, powers of two."""
    known = draw.known(count)
    qp, n_f = known.qp, known.fixed.shape[-1]
    unit = draw.powers(-6, 6, qp.n_z).log2().round().exp2()
    changes = {
        "H": qp.H / unit / unit[:, None],
        "q": qp.q / unit,
        "C": qp.C / unit,
        "G": qp.G / unit,
    }
    solution = {"fixed": known.fixed * unit[:n_f], "z": known.z * unit, "xi": known.xi / unit[:n_f]}
    return solvable(replace(changed(known, **changes), **solution))


def layouts(draw: Draw, count: int) -> Case:
    """Non-contiguous and expanded tensors."""
    known = draw.known(count, matrices=())
    parts = {name: torch.stack((x, x), -1)[..., 0] for name, x in vars(known.qp).items()}
    for name in ("H", "C", "G"):
        parts[name] = parts[name].expand(count, -1, -1)
    known = changed(known, **parts)
    return solvable(replace(known, fixed=known.fixed.mT.contiguous().mT))


def float32(draw: Draw, count: int) -> Case:
    return solvable(draw.known(count, dtype=torch.float32), FLOAT32)


def empty_or_single(draw: Draw, count: int) -> Case:
    return solvable(draw.known(draw.randint(0, 1)))


def after_training(draw: Draw, count: int) -> Case:
    """Matrices after training with an absurd learning rate."""
    H, C, G, n_f = draw.choice(trained())
    soft = draw.rows(SOFT_ROWS, len(G), len(G))
    return solvable(draw.known(count, n_z=len(H), n_f=n_f, H=H, C=C, G=G, soft=soft, hard=()))


def parallel_rows(draw: Draw, count: int) -> Case:
    """An equality a'z = b, and the same row as an inequality, rounded to 6 to 12 digits.

    The optimum of 1/2 |z|^2 + q'z is that of exact arithmetic.
    """
    digits, n = draw.randint(6, 12), draw.randint(3, 6)
    a, b, q = draw.normal(count, n), draw.normal(count), draw.normal(count, n)
    factor = draw.powers(-1, 1, count)
    g, h = _rounded(factor[:, None] * a, digits), _rounded(factor * b, digits)
    exact = [_exact(*qp) for qp in zip(q, a, b, g, h, strict=True)]
    z, value, chi, lam = (torch.tensor(x, dtype=torch.float64) for x in zip(*exact, strict=True))
    qp = QuadraticProgram(
        H=torch.eye(n).double(),
        q=q,
        c=torch.zeros(()).double(),
        C=a[:, None],
        b=b[:, None],
        G=g[:, None],
        lb=torch.full((1,), -torch.inf).double(),
        ub=h[:, None],
        w=torch.full((1,), torch.inf).double(),
    )
    none = torch.zeros(count, 0).double()
    return solvable(KnownQP(qp, none, value, z, 0 * lam, chi, lam, none))


def _rounded(x: Tensor, digits: int) -> Tensor:
    return torch.tensor(
        [float(f"{v:.{digits}g}") for v in x.flatten().tolist()], dtype=torch.float64
    ).reshape(x.shape)


def _exact(*data: Tensor) -> tuple[list, float, list, list]:
    """Solve min 1/2 |z|^2 + q'z with a'z = b and g'z <= h, for q, a, b, g, h, by fractions."""
    (q, a, (b,), g, (h,)) = ([Fraction(v) for v in x.reshape(-1).tolist()] for x in data)
    lam = Fraction(0)

    def dot(x: list, y: list) -> Fraction:
        return sum((s * t for s, t in zip(x, y, strict=True)), Fraction(0))

    chi = (-dot(a, q) - b) / dot(a, a)
    z = [-s - chi * t for s, t in zip(q, a, strict=True)]
    if dot(g, z) > h:
        aa, ag, gg = dot(a, a), dot(a, g), dot(g, g)
        r, s = -dot(a, q) - b, -dot(g, q) - h
        chi, lam = (
            (r * gg - s * ag) / (aa * gg - ag * ag),
            (aa * s - ag * r) / (aa * gg - ag * ag),
        )
        z = [-t - chi * u - lam * v for t, u, v in zip(q, a, g, strict=True)]
    return [float(v) for v in z], float(dot(z, z) / 2 + dot(q, z)), [float(chi)], [float(lam)]


@dataclass(frozen=True)
class Plant:
    """An unstable model x+ = A x + B u over a horizon."""

    A: Tensor
    B: Tensor
    horizon: int

    @classmethod
    def of(cls, draw: Draw) -> Plant:
        """Draw a plant of spectral radius 1 to 2, or a Jordan block with such an eigenvalue."""
        n_x, n_u, radius = draw.randint(1, 3), draw.randint(1, 2), draw.uniform(1.0, 2.0)
        A = draw.normal(n_x, n_x)
        if draw.random() < 0.5:
            A = torch.diag(torch.full((n_x - 1,), draw.uniform(0.0, 0.5)), 1)
            A = A.double() + radius * torch.eye(n_x).double()
        A = A * radius / torch.linalg.eigvals(A).abs().max()
        B = draw.powers(-1, 0) * draw.normal(n_x, n_u)
        return cls(A, B, draw.choice([5, 10, 20, 30, 40, 50]))

    @property
    def C(self) -> Tensor:
        return banded_matrix(self.A, self.B, self.horizon)

    @property
    def states(self) -> Tensor:
        n_x, n = len(self.A), sum(self.B.shape)
        return torch.arange(self.C.shape[1]) % n < n_x

    def roll_out(self, s: Tensor, u: Tensor) -> Tensor:
        """Compute z ``(B, n_z)`` from x_0 ``(B, n_x)`` and the actions ``(B, N, n_u)``."""
        parts = [s]
        for action in u.unbind(1):
            s = s @ self.A.mT + action @ self.B.mT
            parts += [action, s]
        return torch.cat(parts, -1)


def unstable_model(draw: Draw, count: int) -> Case:
    """Small predictions of an unstable model."""
    plant = Plant.of(draw)
    C = plant.C
    soft, n_z = draw.rows(SOFT_ROWS, C.shape[1] - 2, C.shape[1] - 2), C.shape[1]
    options = {"C": C, "G": torch.eye(n_z).double(), "soft": soft, "hard": ("inside", "at_upper")}
    n_f = len(plant.A) + draw.choice([0, plant.B.shape[1]])
    return solvable(draw.known(count, n_z=n_z, n_f=n_f, matrices=(), **options))


def vanishing_entries(draw: Draw, count: int) -> Case:
    """A stable model and a cost whose entries fall to 1e-200, as those with exponentials do."""
    plant = Plant.of(draw)
    plant = replace(plant, A=plant.A / (1.01 * torch.linalg.eigvals(plant.A).abs().max()))
    C, n_z = plant.C, plant.C.shape[1]
    low = torch.where(plant.states, draw.choice([-200.0, -40.0, -12.0]), -3.0)
    H = torch.diag(10 ** (low * draw.powers(0, 1, n_z).log10()))
    C = C + draw.powers(-200, -20, *C.shape) * (draw.powers(0, 1, *C.shape) < 1.05)
    hard = ("inside", "at_upper", "at_lower", "inside")
    soft, G = draw.rows(SOFT_ROWS, n_z - 4, n_z - 4), torch.eye(n_z).double()
    options = {"H": H, "C": C, "G": G, "soft": soft, "hard": hard}
    return solvable(draw.known(count, n_z=n_z, n_f=len(plant.A), matrices=(), **options))


def runaway_prediction(draw: Draw, count: int) -> Case:
    """A linear MPC scheme whose states grow although the actions are at their bounds.

    The multipliers of the dynamics follow backwards from stationarity; those of the actions
    determine the active bounds.
    """
    plant = Plant.of(draw)
    (n_x, n_u), N = plant.B.shape, plant.horizon
    u = draw.normal(count, N, n_u)
    z = plant.roll_out(draw.powers(-2, 1, count, 1) * draw.normal(count, n_x), u)
    n_z, states = z.shape[-1], plant.states
    h = torch.where(states, draw.powers(-1, 1, n_z), draw.powers(-3, 0, n_z))
    limit, w = draw.powers(0, 1), draw.powers(0, 2)
    lam = torch.where(states & (z.abs() > limit), w * z.sign(), 0)
    force = (h * z + lam)[:, : N * (n_x + n_u)].unflatten(-1, (N, -1))
    chi = [(h * z + lam)[:, -n_x:]]
    for k in range(N - 1, 0, -1):
        chi.insert(0, force[:, k, :n_x] + chi[0] @ plant.A)
    pull = force[:, :, n_x:] + torch.stack([x @ plant.B for x in chi], 1)
    at_x, far = torch.zeros(count, N, n_x).double(), torch.zeros(count, n_x).double()
    lam = lam - torch.cat((torch.cat((at_x, pull), -1).flatten(1), far), -1)
    width = draw.powers(-1, 1)
    qp = QuadraticProgram(
        H=torch.diag(h),
        q=torch.zeros(n_z).double(),
        c=torch.zeros(()).double(),
        C=plant.C,
        b=torch.zeros(N * n_x).double(),
        G=torch.eye(n_z).double(),
        lb=torch.where(states, -limit, torch.where(lam > 0, z - width, z)),
        ub=torch.where(states, limit, torch.where(lam > 0, z, z + width)),
        w=torch.where(states, w, torch.inf),
        check_values=False,
    )
    chi, sigma = torch.cat(chi, -1), torch.where(states, (z.abs() - limit).clamp(min=0), 0)
    value = (h * z.square()).sum(-1) / 2 + w * sigma.sum(-1)
    xi = -(times(plant.C.mT, chi) + h * z + lam)[:, :n_x]
    return solvable(KnownQP(qp, z[:, :n_x], value, z, sigma, chi, lam, xi))


def hopeless_plant(draw: Draw, count: int) -> Case:
    """An unstable model whose next state leaves its hard bounds for every allowed action."""
    plant = Plant.of(draw)
    n_x, n_z = len(plant.A), plant.C.shape[1]
    sizes = {"n_z": n_z, "n_f": n_x, "C": plant.C, "G": torch.eye(n_z).double()}
    known = draw.known(count, matrices=(), soft=("inside",) * n_z, hard=(), **sizes)
    states, i = plant.states, draw.randrange(n_x)
    s = draw.normal(count, n_x)
    following = times(plant.A, s)[:, i].abs()
    limit = following / (1 + draw.powers(-2, 1, count))
    action = (following - limit) / plant.B[i].abs().sum() / 2
    bound = torch.where(states, limit[:, None], action[:, None])
    # x_0 itself is within wider ones.
    bound[:, :n_x] = torch.inf
    data = {
        "G": torch.eye(n_z).double(),
        "b": torch.zeros(len(plant.C)).double(),
        "lb": -bound,
        "ub": bound,
        "w": torch.full((n_z,), torch.inf).double(),
    }
    known = replace(changed(known, **data), fixed=s)
    return Case(known, torch.full((count,), int(Status.INFEASIBLE)))


FAMILIES: dict[str, Callable[[Draw, int], Case]] = {
    family.__name__.replace("_", " "): family
    for family in (
        well_posed,
        degenerate,
        weakly_active,
        exact_penalty_threshold,
        dependent_rows,
        rank_deficient_C,
        inconsistent_C,
        singular_H,
        zero_H,
        ill_conditioned_H,
        slack_weights,
        absent_and_equal_bounds,
        crossing_bounds,
        infeasible,
        unbounded,
        mixed,
        scaled_cost,
        scaled_variables,
        scaled_constraints,
        scaled_everything,
        scaled_mixed,
        scaled_entries,
        layouts,
        float32,
        empty_or_single,
        after_training,
        parallel_rows,
        unstable_model,
        vanishing_entries,
        runaway_prediction,
        hopeless_plant,
        *prefix.FAMILIES,
    )
}
