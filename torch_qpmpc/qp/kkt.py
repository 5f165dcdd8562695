"""The KKT system of the derivatives, as an operator that traces see and do not enter.

`torch_qpmpc.qp.derivatives` has its formula.
"""

from typing import Any

import numpy as np
import scipy  # imports scipy.optimize at its first use: a third of a second
import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.batching import align, flatten_batch, schema, times
from torch_qpmpc.qp.kernels import linalg
from torch_qpmpc.qp.kernels.active_set import hold
from torch_qpmpc.qp.kernels.batched import largest, multiply, null_space_inverses
from torch_qpmpc.qp.pipeline.arrays import to_tensor
from torch_qpmpc.qp.pipeline.batch import Prepared, Programs
from torch_qpmpc.qp.program import EVENT_SHAPES, NDIMS, Status, broadcast
from torch_qpmpc.qp.solution import saturated_rows
from torch_qpmpc.qp.tracing import has_values, is_differentiating

#: The Schur complement's solution is accepted with a relative residual up to this, ..
REGULAR = 1e-12
#: .. after so many solves of the same system: the first, and a refinement.
PASSES = 2
#: H is flat in a direction whose curvature is, relative to its largest entry, below this.
FLAT = 1e-14
#: A multiplier is zero, and a row at its bound, within this fraction of their sizes.
ZERO = 1e-9
#: Curvature counts as no less than this fraction of the largest.
CURVED = 1e-5
#: Unit normals that differ by at most this are parallel: data in float32 are no more accurate.
PARALLEL = 1e-6
#: Rounding errors grow by more than this along an unstable model.
GROWTH = 1e3
#: Event dimensions of the operator's tensors: four gradients; z, lam, status; H, .., fixed.
KKT_NDIMS = (1, 1, 1, 1, 1, 1, 0, *NDIMS, 1)


def kkt(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Call `solve_kkt` in the form that the current trace supports; its derivative raises."""
    if torch.compiler.is_compiling():
        return kkt_op(*arguments)
    if not is_differentiating() and has_values(*arguments[:-1]):
        return solve_kkt(*arguments)
    return Opaque.apply(*arguments)


def solve_kkt(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Solve the KKT system in condensed form for the whole batch at once, on the CPU.

    Returns p ``(*batch, n_z)``, r ``(*batch, n_c)``, t ``(*batch, n_g)`` and u ``(*batch, n_f)``.

    The ``arguments`` are the gradients in z, lam, chi and xi; z, lam, status; H, .., fixed; and
    n_kept of `Programs.of`. The gradients of unsolved elements are zero.
    """
    *tensors, n_kept = arguments
    grad_z, grad_lam, grad_chi, grad_xi, z, lam, status, *theta, fixed = (x.cpu() for x in tensors)
    # Under vmap the gradients may have batch dimensions that the QP lacks.
    vectors = (grad_z, grad_lam, grad_chi, grad_xi, z, lam, fixed)
    batch = broadcast(*(x.shape[:-1] for x in vectors), status.shape)
    fixed = fixed.expand(*batch, fixed.shape[-1])
    programs, batch = Programs.of(*theta, fixed, n_kept=n_kept)
    solved = (status == Status.SOLVED).expand(batch).reshape(-1)
    which = solved.nonzero().squeeze(-1)
    solvable = programs if solved.all() else programs.take(which.numpy())

    def flat(x: Tensor) -> Tensor:
        return flatten_batch(x.expand(*batch, x.shape[-1]))[which].double()

    solutions = _solve_in_units(solvable, *map(flat, vectors[:6])) if len(solvable) else ()
    like = z, theta[4], lam, fixed
    results = tuple(z.new_zeros(len(solved), x.shape[-1]) for x in like)
    for x, solution in zip(results, solutions, strict=False):
        x[which] = solution.to(x)
    p, r, t, u = (x.reshape(*batch, x.shape[-1]).to(tensors[4].device) for x in results)
    return p, r, t, u


def _solve_in_units(programs: Programs, *vectors: Tensor) -> tuple[Tensor, ...]:
    """Return `_solve_kkt` of QPs in their own units: zero and equal are relative to these."""
    if (units := programs.prepared.units) is None:
        return _solve_kkt(programs, *vectors)
    cost, z, rows, equalities = map(to_tensor, units.per_qp(units.group))
    fixed = z[:, : programs.n_f]
    sizes = z, cost / rows, cost / equalities, cost / fixed, 1 / z, rows / cost
    scaled = (x * size for x, size in zip(vectors, sizes, strict=True))
    p, r, t, u = _solve_kkt(programs.scaled(), *scaled)
    return p * (z / cost), r / equalities, t / rows, u / fixed


def _solve_kkt(programs: Programs, *vectors: Tensor) -> tuple[Tensor, ...]:
    grad_z, grad_lam, grad_chi, grad_xi, z, lam = vectors
    n_f, theta = programs.n_f, programs.prepared.theta
    group, H, C, G = map(to_tensor, (programs.group, theta.H, theta.C, theta.G))
    condensed = programs.prepared.condensed(n_f)
    T, H_y, G_y = map(to_tensor, (condensed.T, condensed.H, condensed.G))
    factors = *condensed[1:3], condensed.spans[4], programs.group
    active = _rows_at_bounds(programs, z, lam)
    rows = programs.prepared.sizes(n_f).bounds
    alone = active.numpy()[:, rows[rows >= 0]] & (not condensed.deficient)
    if alone.any() and programs.prepared.growth(n_f) > GROWTH:
        return _solve_pinned(programs, rows[rows >= 0], alone, *vectors)
    T_f, T = T[:, :, :n_f], T[:, :, n_f:]
    right, right_t, particular = grad_z, grad_lam, torch.zeros_like(z)
    if grad_chi.any() or grad_xi.any():
        # A solution of C p = dl/dchi and E p = dl/dxi; the condensed system gives the rest.
        particular = multiply(T_f, group, grad_xi)
        particular += to_tensor(linalg.particular(*factors, grad_chi.numpy(), z.shape[1]))
        right = right - multiply(H, group, particular)
        right_t = right_t - multiply(G, group, particular)
    system = H_y[:, n_f:, n_f:], G_y[:, :, n_f:], active, multiply(T.mT, group, right)
    v, t = _solve_active(programs, *system, torch.where(active, right_t, 0))
    p_z = particular + multiply(T, group, v)
    left = grad_z - multiply(H, group, p_z) - multiply(G.mT, group, t)
    r = -to_tensor(linalg.multipliers(*factors, left.numpy()))
    u = left[:, :n_f] - multiply(C[:, :, :n_f].mT, group, r)
    return p_z, r, t, u


def _solve_pinned(
    programs: Programs, rows: np.ndarray, alone: np.ndarray, *vectors: Tensor
) -> tuple[Tensor, ...]:
    """Do as `_solve_kkt` with equations for the rows that hold an entry of z ``alone``, ``(B, k)``.

    They leave no rounding errors of these entries, which would grow along an unstable model.
    """
    p, t, r, u = map(torch.zeros_like, vectors[:4])
    masks, which = np.unique(alone, axis=0, return_inverse=True)
    for k, mask in enumerate(masks):
        index, own, n = np.flatnonzero(which.reshape(-1) == k), rows[mask], mask.sum()
        part = programs.take(index)
        theta, M = part.theta, max(map(len, part.theta[1:3]))
        C = [x.repeat(M // len(x), 0) for x in (theta.G[:, own], theta.C)]
        theta = theta._replace(C=np.hstack(C), b=np.pad(theta.b, ((0, 0), (n, 0))))
        inner = Programs(Prepared(theta, part.group, part.n_f), part.group, part.fixed)
        of_z, of_lam, of_chi, *rest = (x[index] for x in vectors)
        of_C = torch.cat((of_lam[:, own], of_chi), dim=1)
        p[index], of_C, t[index], u[index] = _solve_kkt(inner, of_z, of_lam, of_C, *rest)
        t[index[:, None], own], r[index] = of_C[:, :n], of_C[:, n:]
    return p, r, t, u


def _rows_at_bounds(programs: Programs, z: Tensor, lam: Tensor) -> Tensor:
    """Return the mask of rows y = G z that stay at a bound if the data change, ``(B, n_g)``.

    They are those with lb = ub, those whose multiplier is beyond rounding and exceeds their slack,
    and those that `implied_equalities` adds. In units of y that make H's diagonal one, y and lam
    are roots of costs: they compare, with each other and with z, in all units of a QP.
    """
    reduced, theta = programs.prepared.reduced(programs.n_f), programs.theta
    group, rows, held = to_tensor(programs.group), reduced.rows, torch.zeros_like(lam).bool()
    curvature = to_tensor(reduced.H).diagonal(dim1=1, dim2=2).abs()
    flat = CURVED * largest(curvature, keepdim=True)
    curvature = curvature.maximum(flat.where(flat > 0, 1)).unsqueeze(1)
    unit = (to_tensor(reduced.G) ** 2 / curvature).sum(-1).sqrt()[group]
    lower, upper = (to_tensor(x[:, rows]) / unit for x in theta[6:8])
    w, lam = to_tensor(theta.w[:, rows]) * unit, lam[:, rows] * unit
    y = multiply(to_tensor(theta.G), group, z)[:, rows] / unit
    size = multiply(to_tensor(theta.H).diagonal(dim1=1, dim2=2).abs()[:, None], group, z**2).sqrt()
    near, slack = ZERO * (size + y.abs()), torch.where(lam > 0, upper - y, y - lower)
    force = lam.abs()
    saturated = saturated_rows(lam, w) | (-slack > w - force)
    own = (force > ZERO * size) & (slack < near.maximum(force)) | (lower >= upper)
    own, free = own & ~saturated, ~(own | saturated)
    below, above = free & (y - lower <= near), free & (upper - y <= near)
    if (weak := (below | above).any(-1)).any():
        masks = (x[weak].numpy() for x in (below, above, own))
        own[weak] |= to_tensor(_all_implied(reduced.G, programs.group[weak.numpy()], *masks))
    held[:, rows] = own
    return held


def _all_implied(
    G: np.ndarray, group: np.ndarray, lower: np.ndarray, upper: np.ndarray, held: np.ndarray
) -> np.ndarray:
    """Return `implied_equalities` of each QP, computed once for QPs with equal arguments."""
    keys = np.concatenate((group[:, None], lower, upper, held), axis=1)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    masks = [implied_equalities(G[group[i]], lower[i], upper[i], held[i]) for i in first]
    return np.stack(masks)[inverse.reshape(-1)]


def _in_cone(normals: np.ndarray, x: np.ndarray) -> bool:
    """Return True if x is a non-negative combination of the rows of ``normals``."""
    try:
        return scipy.optimize.nnls(normals.T, x)[1] < PARALLEL
    except RuntimeError:  # nnls did not converge: the row stays as its multiplier says
        return False


def implied_equalities(
    G: np.ndarray, lower: np.ndarray, upper: np.ndarray, held: np.ndarray
) -> np.ndarray:
    """Return a mask of independent weakly active rows that others turn into equalities, ``(n_g,)``.

    A row with outward normal n stays at its bound if -n is a non-negative combination of the
    others' normals plus any of the ``held`` rows': no feasible direction leaves it. Two opposite
    rows are the simplest case. ``lower`` and ``upper`` are masks of the rows of G ``(n_g, d)``, in
    the free variables, with a zero multiplier at these bounds.
    """
    sizes = np.linalg.norm(G, axis=-1, keepdims=True)
    G, implied = G / np.where(sizes > 0, sizes, 1), np.zeros_like(held)
    rows = np.concatenate((upper.nonzero()[0], lower.nonzero()[0]))
    normals = np.concatenate((G[upper], -G[lower]))
    if held.any():
        basis = scipy.linalg.orth(G[held].T, rcond=PARALLEL)
        normals -= normals @ basis @ basis.T
    rest = np.linalg.norm(normals, axis=-1)
    free = rest > PARALLEL  # the others depend on held rows
    rows, normals = rows[free], normals[free] / rest[free, None]
    if np.linalg.matrix_rank(normals, tol=PARALLEL) < len(rows):
        stuck = [_in_cone(normals, -n) for n in normals]
        rows, normals = rows[stuck], normals[stuck]
        _, R, order = scipy.linalg.qr(normals.T, mode="economic", pivoting=True)
        implied[rows[order[: int((np.abs(R.diagonal()) > PARALLEL).sum())]]] = True
    return implied


def _solve_active(
    programs: Programs, H: Tensor, G: Tensor, active: Tensor, right_v: Tensor, right_t: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve ``H v + G't = right_v, G v = right_t``; t and right_t are zero in inactive rows.

    H is factorised once for each theta, and the Schur complement of the active rows for each QP.
    """
    group = to_tensor(programs.group)
    dual = programs.prepared.dual(programs.n_f)
    _, unit, inverse, to_v, _ = map(to_tensor, dual)
    unit, rows = unit[group], to_tensor(programs.prepared.reduced(programs.n_f).rows)
    v, t, of_v, of_t = torch.zeros_like(right_v), torch.zeros_like(right_t), right_v, right_t
    held, size = active[:, rows], largest(right_v) * 0
    terms, regular = size, size < 0
    for _ in range(PASSES):
        free, change = multiply(inverse, group, of_v), multiply(to_v, group, of_v)
        change = change - of_t[:, rows] / unit
        dt = to_tensor(hold(dual.K, programs.group, held.numpy(), change.numpy()))
        dv = free - multiply(to_v.mT, group, dt)
        v, t = v + dv, t.index_add(1, rows, dt / unit)
        of_v = right_v - multiply(H, group, v) - multiply(G.mT, group, t)
        of_t = torch.where(active, right_t - multiply(G, group, v), 0)
        size = size + largest(dv) + largest(free)  # the active rows may cancel v
        terms = largest(right_v) + largest(H.flatten(1))[group] * size
        of_rows = right_t.abs() + largest(G)[group] * size.unsqueeze(-1)
        regular = (largest(of_v) <= REGULAR * terms) & (of_t.abs() <= REGULAR * of_rows).all(-1)
        if regular.all():
            break
    # Where terms of G't cancel to a fraction of their size, rows are dependent but for rounding.
    strained = PARALLEL * largest(largest(G)[group] * t) > terms
    if (again := ~regular | strained).any():
        index, rest = group[again], (x[again] for x in (active, right_v, right_t))
        v[again], t[again] = _solve_dense(H[index], G[index], *rest)
    return v, t


def _solve_dense(
    H: Tensor, G: Tensor, active: Tensor, right_v: Tensor, right_t: Tensor
) -> tuple[Tensor, Tensor]:
    """Do as `_solve_active`, also for dependent rows and directions without curvature.

    Of all v and t it returns those of least norm.
    """
    A = G.masked_fill(~active.unsqueeze(-1), 0)
    size = torch.linalg.vector_norm(A, dim=-1)
    size = size.where(size > 0, 1)
    of_A, of_H, _ = null_space_inverses(H, A / size.unsqueeze(-1), PARALLEL, FLAT)
    v = times(of_A, right_t / size)
    v = v + times(of_H, right_v - times(H, v))
    return v, times(of_A.mT, right_v - times(H, v)) / size


NAMES = ("grad_z", "grad_lam", "grad_chi", "grad_xi", "z", "lam", "status", *EVENT_SHAPES, "fixed")
kkt_op = torch.library.custom_op(
    "torch_qpmpc::solve_kkt", solve_kkt, mutates_args=(), schema=schema(NAMES, "int n_kept", 4)
)


@kkt_op.register_fake
def _(grad_z, grad_lam, grad_chi, grad_xi, z, lam, status, *theta):
    return tuple(torch.empty_like(x) for x in (grad_z, grad_chi, grad_lam, grad_xi))


@kkt_op.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return kkt_op(*align(in_dims, args, KKT_NDIMS)), (0,) * 4


class Opaque(torch.autograd.Function):
    """`kkt_op`, not differentiable: its derivative is the second of the solution."""

    @staticmethod
    def forward(*args):
        return kkt_op(*args)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple:
        got = "the second of the solution, or the third of the value"
        want = "at most the first of the solution, or the second of the value"
        raise QPError.expected("derivative", got, want, "Detach the tensors that need no gradient.")

    @staticmethod
    def jvp(ctx: Any, *_: Tensor) -> tuple:
        return Opaque.backward(ctx)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return Opaque.apply(*align(in_dims, args, KKT_NDIMS)), (0,) * 4
