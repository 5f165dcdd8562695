"""Loops over QPs, compiled by Numba for the CPU: what takes torch dozens of small operations.

For the QP of eq:qp2 and eq:qp3: the full solution from that of its condensed form, the certificate,
active sets tried again, which QP to solve after which, and the gradient of the value in a theta
that the batch shares (eq:gradq). A torch operation costs some microseconds whatever its size, as
much as a whole QP here. On other devices the torch forms beside the callers do the same; tests hold
the two against each other.

Arrays are float64 and contiguous. Of a vector ``(B or 1, n)``, all QPs share a single row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.extending import intrinsic
from torch import Tensor

#: Entries of the matrix times vectors up to which a product by BLAS stays in one thread.
ONE_THREAD = 2**18
#: Entries that are compared before the others are: of another theta, some of them mostly differ.
FIRST = 64
#: QPs at a time whose full solutions stay in a core's cache while they are worked out.
TOGETHER = 64


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """``function`` in machine code, kept on disk where a folder for that can be written."""
    try:
        return numba.njit(cache=True, error_model="numpy", **options)(function)
    except RuntimeError:
        return numba.njit(error_model="numpy", **options)(function)


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """The tensors of any device as a kernel takes them, detached; those on the CPU not copied."""
    # Each step of the way costs as much as a kernel spends on a QP: none without need.
    return [(x if x.is_contiguous() else x.contiguous()).numpy(force=True) for x in tensors]


def tensors(found: Iterable[np.ndarray], device: torch.device) -> list[Tensor]:
    """What kernels found, on a device."""
    on_cpu = [torch.from_numpy(x) for x in found]
    return on_cpu if device.type == "cpu" else [x.to(device) for x in on_cpu]


@compiled
def recover(
    v, lam_v, group, fixed, rows, others, T_T, Y_neg, C, C_T, H, G, G_T, diagonal, at_zero,
    q, c, b, lb, ub, w, violated,
):  # fmt: skip
    """Value, z, sigma, chi, lam, xi, status, residual and worst of `solvers.chain._recover`.

    ``at_zero`` ``(B or 1, n_z)`` is z where the fixed entries and v are zero, ``T_T``, ``C_T`` and
    ``G_T`` are transposes, and ``diagonal`` says of H and G whether they have nothing else.
    """
    n_qps = len(fixed)
    value, residual = np.empty(n_qps), np.empty(n_qps)
    z, chi, xi = np.empty((n_qps, H.shape[1])), np.empty((n_qps, C.shape[1])), np.empty(fixed.shape)
    sigma, lam = np.empty((n_qps, G.shape[1])), np.empty((n_qps, G.shape[1]))
    worst = 0.0
    for i in range(0, n_qps, TOGETHER):
        k = min(i + TOGETHER, n_qps)
        _recover_some(
            value[i:k], z[i:k], sigma[i:k], chi[i:k], lam[i:k], xi[i:k], residual[i:k],
            v[i:k], lam_v[i:k], group[i:k], fixed[i:k], rows, others,
            T_T, Y_neg, C, C_T, H, G, G_T, diagonal, _some(at_zero, i, k), _some(q, i, k),
            c if len(c) == 1 else c[i:k], _some(b, i, k), _some(lb, i, k), _some(ub, i, k),
            _some(w, i, k), violated,
        )  # fmt: skip
        for j in range(i, k):
            worst = max(worst, residual[j])
    return value, z, sigma, chi, lam, xi, np.zeros(n_qps, np.int64), residual, worst


@compiled
def _some(vectors, i, k):
    """What the QPs from i to k have of ``(B or 1, n)``."""
    return vectors if len(vectors) == 1 else vectors[i:k]


@compiled
def _recover_some(
    value, z, sigma, chi, lam, xi, residual,
    v, lam_v, group, fixed, rows, others, T_T, Y_neg, C, C_T, H, G, G_T, diagonal, at_zero,
    q, c, b, lb, ub, w, violated,
):  # fmt: skip
    """Fill in what `recover` finds of a few QPs."""
    n_qps, n_f = fixed.shape
    kept = np.empty((n_qps, T_T.shape[1]))
    for i in range(n_qps):
        for j in range(n_f):
            kept[i, j] = fixed[i, j]
        for j in range(v.shape[1]):
            kept[i, n_f + j] = v[i, j]
    _fill(z, kept, T_T, group, False)
    for i in range(n_qps):
        of_z = i % len(at_zero)
        for j in range(z.shape[1]):
            z[i, j] += at_zero[of_z, j]
    Hz, y = products(z, H, group, diagonal[0]), products(z, G_T, group, diagonal[1])
    lam[:] = 0.0
    for i in range(n_qps):
        of_lb, of_ub, of_w = i % len(lb), i % len(ub), i % len(w)
        for k in range(len(rows)):
            lam[i, rows[k]] = lam_v[i, k]
        # A loop of its own, to be compiled four at a time; what is zero stays so.
        for j in range(lam.shape[1]):
            push, most = lam[i, j], w[of_w, j]
            lam[i, j] = most if push > most else -most if push < -most else push
        for j in others:
            if w[of_w, j] < np.inf:  # violated, a hard row stays so
                if y[i, j] - ub[of_ub, j] > violated:
                    lam[i, j] = w[of_w, j]
                elif lb[of_lb, j] - y[i, j] > violated:
                    lam[i, j] = -w[of_w, j]
    G_lam = products(lam, G, group, diagonal[1])
    left = np.empty(z.shape)
    for i in range(n_qps):
        of_q = i % len(q)
        for j in range(z.shape[1]):
            left[i, j] = Hz[i, j] + q[of_q, j] + G_lam[i, j]
    _fill(chi, left, Y_neg, group, False)
    C_chi = products(chi, C, group, False)
    for i in range(n_qps):
        for j in range(z.shape[1]):
            left[i, j] += C_chi[i, j]
        for j in range(n_f):
            xi[i, j], left[i, j] = -left[i, j], 0.0 * left[i, j]
    Cz = products(z, C_T, group, False)
    _judge(
        value, sigma, residual, z, Hz, G_lam, C_chi, left, y, lam, chi, Cz, fixed,
        q, c, b, lb, ub, w,
    )  # fmt: skip


@compiled
def is_finite(vectors):
    """Whether all entries are."""
    # Their sum is, but for overflow, which no solver survives either.
    return np.isfinite(vectors.sum())


@compiled
def are_equal(x, y):
    """Whether two arrays of one shape are."""
    x, y = x.ravel(), y.ravel()
    for n in (min(len(x), FIRST), len(x)):
        different = 0
        for i in range(n):
            different += x[i] != y[i]
        if different:
            return False
    return True


@compiled
def affine(vectors, matrices, group, constant):
    """`products` plus ``constant`` ``(B or 1, j)``, of few entries: not by BLAS.

    So what a sample alone is rounded to, it is rounded to in a batch.
    """
    found = np.empty((len(vectors), constant.shape[1]))
    for i in range(len(vectors)):
        of_constant = i % len(constant)
        for j in range(found.shape[1]):
            found[i, j] = constant[of_constant, j]
        add_product(found[i], vectors[i], matrices[group[i]])
    return found


@compiled
def products(vectors, matrices, group, diagonal):
    """Each QP's transposed matrix times its vector, ``(M, i, j)`` and ``(B, i)`` to ``(B, j)``."""
    found = np.empty((len(vectors), matrices.shape[2]))
    _fill(found, vectors, matrices, group, diagonal)
    return found


@compiled
def _fill(found, vectors, matrices, group, diagonal):
    """`products`, to ``found``."""
    if diagonal:
        factors = np.diag(matrices[0]).copy()
        for i in range(len(vectors)):
            for j in range(vectors.shape[1]):
                found[i, j] = vectors[i, j] * factors[j]
    elif len(matrices) == 1 and matrices.size:
        some = max(1, ONE_THREAD // matrices.size)
        for i in range(0, len(vectors), some):
            np.dot(vectors[i : i + some], matrices[0], found[i : i + some])
    else:
        found[:] = 0.0
        for i in range(len(vectors) if matrices.size else 0):
            add_product(found[i], vectors[i], matrices[group[i]])


@compiled
def judge(z, Hz, G_lam, C_chi, left, y, lam, chi, Cz, fixed, q, c, b, lb, ub, w):
    """Value ``(B,)``, sigma ``(B, n_g)`` and residual ``(B,)`` of `certificate.certify`."""
    value, residual, sigma = np.empty(len(z)), np.empty(len(z)), np.empty(y.shape)
    _judge(
        value, sigma, residual, z, Hz, G_lam, C_chi, left, y, lam, chi, Cz, fixed,
        q, c, b, lb, ub, w,
    )  # fmt: skip
    return value, sigma, residual


@compiled
def _judge(
    value, sigma, residual, z, Hz, G_lam, C_chi, left, y, lam, chi, Cz, fixed, q, c, b, lb, ub, w
):
    """`judge`, to ``value``, ``sigma`` and ``residual``."""
    for i in range(len(z)):
        of_q, of_b = i % len(q), i % len(b)
        of_lb, of_ub, of_w = i % len(lb), i % len(ub), i % len(w)
        cost, slip = _cost(z, Hz, left, q, i, of_q)
        charge, gap = _charge(y, lam, lb, ub, w, sigma, i, of_lb, of_ub, of_w)
        cost, slip = cost + charge, slip + gap + _shortage(Cz, b, chi, i, of_b)
        force, slope, length = _forces(z, Hz, G_lam, C_chi, left, q, i, of_q)
        short, size = _distance(Cz, b, i, of_b)
        error = max(slope / (1.0 + force), short / (1.0 + size + length))
        error = max(error, _distance(z, fixed, i, i)[0])
        error = max(error, _excess(y, lam, lb, ub, w, i, of_lb, of_ub, of_w))
        slip /= 1.0 + abs(cost)
        worst = max(error, slip)
        value[i] = cost + c[i % len(c)]
        # A NaN of any entry is in the sums; the largest sizes know nothing of it.
        residual[i] = worst if slip < np.inf and worst < np.inf else np.inf


# Four entries at a time: sums in any order, and largest sizes as if nothing were NaN.
summing = partial(compiled, fastmath={"reassoc", "contract"})
_comparing = partial(compiled, fastmath={"nnan", "nsz"})


def _larger(_, x, y):
    """max(x, y) of what is not NaN, four at a time in a loop; Python's is compiled one by one."""

    def generate(_, builder, signature, numbers):
        double = ir.DoubleType()
        kind = ir.FunctionType(double, (double, double))
        maximum = builder.module.declare_intrinsic("llvm.maxnum", (double,), kind)
        return builder.call(maximum, numbers)

    return numba.float64(numba.float64, numba.float64), generate


larger: Any = intrinsic(_larger)


@summing
def _cost(z, Hz, left, q, i, k):
    """(q + Hz / 2) z, and what stationarity left is worth."""
    cost = slip = 0.0
    for j in range(z.shape[1]):
        cost += (q[k, j] + 0.5 * Hz[i, j]) * z[i, j]
        slip += abs(left[i, j] * z[i, j])
    return cost, slip


@summing
def _charge(y, lam, lb, ub, w, sigma, i, of_lb, of_ub, of_w):
    """w sigma and the rows' complementarity gaps; fills in sigma."""
    total = slip = 0.0
    for j in range(y.shape[1]):
        at, push, weight = y[i, j], lam[i, j], w[of_w, j]
        above, below = ub[of_ub, j], lb[of_lb, j]
        outside = at - above if at > above else below - at if at < below else 0.0
        outside = 0.0 if weight == np.inf else outside
        charge = outside * (0.0 if weight == np.inf else weight)
        # NaN is neither, and stays.
        up, down = 0.0 if push < 0 else push, 0.0 if push > 0 else push
        above, below = 0.0 if above == np.inf else above, 0.0 if below == -np.inf else below
        sigma[i, j] = outside
        total += charge
        slip += abs(charge + (above - at) * up + (below - at) * down)
    return total, slip


@summing
def _shortage(Cz, b, chi, i, k):
    """What C z = b lacks is worth."""
    slip = 0.0
    for j in range(b.shape[1]):
        slip += abs((Cz[i, j] - b[k, j]) * chi[i, j])
    return slip


@_comparing
def _forces(z, Hz, G_lam, C_chi, left, q, i, k):
    """The largest sizes of the terms of stationarity, of what they leave, and of z."""
    force = slope = length = 0.0
    for j in range(z.shape[1]):
        force = larger(force, larger(abs(q[k, j]), abs(Hz[i, j])))
        force = larger(force, larger(abs(G_lam[i, j]), abs(C_chi[i, j])))
        slope, length = larger(slope, abs(left[i, j])), larger(length, abs(z[i, j]))
    return force, slope, length


@_comparing
def _distance(x, y, i, k):
    """The largest difference of x from y, and size of y."""
    difference = size = 0.0
    for j in range(y.shape[1]):
        difference, size = larger(difference, abs(x[i, j] - y[k, j])), larger(size, abs(y[k, j]))
    return difference, size


@_comparing
def _excess(y, lam, lb, ub, w, i, of_lb, of_ub, of_w):
    """The largest violation of a hard row, multiplier beyond w, or multiplier of no bound."""
    error = 0.0
    for j in range(y.shape[1]):
        at, push, weight = y[i, j], lam[i, j], w[of_w, j]
        above, below = ub[of_ub, j], lb[of_lb, j]
        hard = weight == np.inf
        excess = larger(at - above, below - at) if hard else abs(push) - weight
        excess /= 1.0 + (abs(at) if hard else weight)
        astray = larger(push if above == np.inf else 0.0, -push if below == -np.inf else 0.0)
        error = larger(error, larger(excess, astray))
    return error


@compiled
def add(x, factor, y):
    """x += factor y."""
    for j in range(len(x)):
        x[j] += factor * y[j]


@compiled
def add_product(x, factors, matrix):
    """x += matrix' factors, four rows at a time: x is read and written as much less often."""
    whole = len(factors) - len(factors) % 4
    for j in range(0, whole, 4):
        f, g, h, p = factors[j], factors[j + 1], factors[j + 2], factors[j + 3]
        for k in range(len(x)):
            x[k] += (f * matrix[j, k] + g * matrix[j + 1, k]) + (
                h * matrix[j + 2, k] + p * matrix[j + 3, k]
            )
    if whole + 2 <= len(factors):
        f, g = factors[whole], factors[whole + 1]
        for k in range(len(x)):
            x[k] += f * matrix[whole, k] + g * matrix[whole + 1, k]
    if len(factors) % 2:
        for k in range(len(x)):
            x[k] += factors[-1] * matrix[len(factors) - 1, k]


@compiled
def envelope(incoming, z, sigma, chi, lam, xi, status, of_H, of_C, of_G):
    """`autograd.envelope_gradients` of a theta that the batch shares.

    ``incoming`` and ``status`` are ``(B,)``. Of the ten gradients, those in H, C and G are empty
    where they are not asked for.
    """
    n_qps, n_z = z.shape
    weight, weighted_z = np.empty(n_qps), np.empty(z.shape)
    for i in range(n_qps):
        # Zero times an infinite gradient would be NaN.
        weight[i] = incoming[i] if status[i] == 0 else 0.0
        for j in range(n_z):
            weighted_z[i, j] = weight[i] * z[i, j]
    H = _summed_outer(weighted_z, z, of_H)
    for i in range(H.shape[0]):
        for j in range(n_z):
            H[i, j] *= 0.5
    c, q, b, of_w = np.zeros(()), np.zeros(n_z), np.zeros(chi.shape[1]), np.zeros(lam.shape[1])
    of_lb, of_ub, fixed = np.zeros(lam.shape[1]), np.zeros(lam.shape[1]), np.empty(xi.shape)
    for i in range(n_qps):
        c[()] += weight[i]
        for j in range(n_z):
            q[j] += weighted_z[i, j]
        for j in range(chi.shape[1]):
            b[j] -= weight[i] * chi[i, j]
        for j in range(lam.shape[1]):
            of_lb[j] -= weight[i] * min(lam[i, j], 0.0)
            of_ub[j] -= weight[i] * max(lam[i, j], 0.0)
            of_w[j] += weight[i] * sigma[i, j]
        for j in range(xi.shape[1]):
            fixed[i, j] = -weight[i] * xi[i, j]
    C = _summed_outer(chi, weighted_z, of_C)
    G = _summed_outer(lam, weighted_z, of_G)
    return H, q, c, C, b, G, of_lb, of_ub, of_w, fixed


@compiled
def _summed_outer(left, right, needed):
    """The sum of ``left_i right_i'``, ``(B, m)`` and ``(B, n)`` to ``(m, n)``; or nothing."""
    if not needed:
        return np.empty((0, right.shape[1]))
    found = np.zeros((left.shape[1], right.shape[1]))
    some = max(1, ONE_THREAD // max(1, found.size))
    for i in range(0, len(left) if found.size else 0, some):
        found += np.dot(left[i : i + some].T, right[i : i + some])
    return found


@compiled
def active_sets(z, lam, status, G, lb, ub, w, unknown):
    """`qp.QPSolution.active` of a theta that the batch shares, ``(B, n_g)``."""
    G_T, group = np.ascontiguousarray(G.T), np.zeros(len(z), np.int64)
    y = products(z, G_T.reshape((1, *G_T.shape)), group, False)
    codes = np.empty(lam.shape, np.int8)
    for i in range(len(z)):
        for j in range(lam.shape[1]):
            at = y[i, j] + lam[i, j]
            excess = at - min(max(at, lb[j]), ub[j])
            held = min(max(excess, -w[j]), w[j])
            code = np.sign(held) * 2
            if held == excess and (excess != 0 or lb[j] == ub[j]):
                code = np.sign(lam[i, j])
            codes[i, j] = code if status[i] == 0 else unknown
    return codes


def tour(vectors: np.ndarray, near: int) -> np.ndarray:
    """An order of vectors ``(B, n)``: from each to the nearest of the next ``near`` that are left.

    A nearest-neighbour tour in units of the entries' standard deviations; of more than ``near``
    vectors, the next ones are those in the order of their first entry.
    """
    few = len(vectors) <= near or not vectors.shape[1]
    order = np.arange(len(vectors)) if few else vectors[:, 0].argsort()
    _walk(vectors, order, near)
    return order


# Several entries at a time, in any order; a tour of NaN is as good as any.
@partial(compiled, fastmath={"reassoc", "nsz", "nnan", "contract"})
def _walk(vectors, order, near):
    """Put ``order`` in the order of `tour`."""
    n_qps, n = vectors.shape
    points, distance = np.empty((n, n_qps), np.float32), np.empty(near, np.float32)
    for k in range(n):
        mean = square = 0.0
        for i in range(n_qps):
            mean += vectors[i, k] / n_qps
        for i in range(n_qps):
            square += (vectors[i, k] - mean) ** 2 / n_qps
        for i in range(n_qps):
            points[k, i] = (vectors[order[i], k] - mean) / (
                math.sqrt(square) if square > 0 else 1.0
            )
    for at in range(n_qps - 1):
        left, nearest = min(near, n_qps - 1 - at), 0
        for j in range(left):
            distance[j] = 0.0
        for k in range(n):
            for j in range(left):
                distance[j] += (points[k, at + 1 + j] - points[k, at]) ** 2
        for j in range(left):
            nearest = j if distance[j] < distance[nearest] else nearest
        nearest += at + 1
        order[at + 1], order[nearest] = order[nearest], order[at + 1]
        for k in range(n):
            points[k, at + 1], points[k, nearest] = points[k, nearest], points[k, at + 1]


@compiled
def recall(free, push, group, codes, lower, upper, w, slip, max_steps, max_passes):
    """v ``(B, d)``, lam ``(B, r)``, steps and which are done ``(B,)`` of `solvers.recall.recall`.

    ``free`` ``(B, d + r)`` is (v, y) without multipliers, and ``push`` ``(M, r, d + r)`` what a
    multiplier takes from it.
    """
    n_qps, r = lower.shape
    d = free.shape[1] - r
    lam, vy, steps = np.zeros((n_qps, r)), free.copy(), np.zeros(n_qps, np.int64)
    done = np.zeros(n_qps, np.bool_)
    code, held, pull = np.empty(r, np.int8), np.empty(r, np.int64), np.empty(r)
    factor = np.empty((r, r))
    for i in range(n_qps):
        code[:] = codes[i]
        by = push[group[i]]
        for j in range(r):
            if not -2 <= code[j] <= 2:
                code[:] = 0
        while not done[i] and steps[i] < max_steps:
            steps[i] += 1
            vy[i] = free[i]
            k = 0
            for j in range(r):
                lam[i, j] = 0.0
                if abs(code[j]) == 2:
                    lam[i, j] = math.copysign(w[i, j], code[j])
                    add(vy[i], -lam[i, j], by[j])
                elif code[j] != 0:
                    held[k] = j
                    k += 1
            if not _factorise(by, held, k, d, factor):
                break
            for _ in range(max_passes):
                unmet = False
                for a in range(k):
                    j = held[a]
                    level = upper[i, j] if code[j] > 0 else lower[i, j]
                    pull[a] = vy[i, d + j] - level
                    unmet = unmet or not abs(pull[a]) <= slip * (1.0 + abs(level))
                if not unmet:
                    break
                _solve_factorised(factor, pull, k)
                for a in range(k):
                    lam[i, held[a]] += pull[a]
                    add(vy[i], -pull[a], by[held[a]])
            done[i] = not _correct(code, lam[i], vy[i, d:], lower[i], upper[i], w[i], slip)
    return vy[:, :d].copy(), lam, steps, done


@compiled
def _factorise(by, held, k, d, factor):
    """Cholesky's upper factor of the held rows and columns of K; whether there is one."""
    for a in range(k):
        for b in range(a, k):
            factor[a, b] = by[held[a], d + held[b]]
    for a in range(k):
        if not factor[a, a] > 0:
            return False
        root = math.sqrt(factor[a, a])
        for b in range(a, k):
            factor[a, b] /= root
        # Slices of rows, to pass on, would take as long as such loops.
        for b in range(a + 1, k):
            for e in range(b, k):
                factor[b, e] -= factor[a, b] * factor[a, e]
    return True


@compiled
def _solve_factorised(factor, x, k):
    for a in range(k):
        x[a] /= factor[a, a]
        for b in range(a + 1, k):
            x[b] -= x[a] * factor[a, b]
    for a in range(k - 1, -1, -1):
        for b in range(a + 1, k):
            x[a] -= factor[a, b] * x[b]
        x[a] /= factor[a, a]


@compiled
def _correct(code, lam, y, lower, upper, w, slip):
    """Put in place the codes that lam and y ask for; whether they contradict the old ones."""
    contradicted = False
    for j in range(len(code)):
        small = slip * (1.0 + abs(y[j]))
        above, below = y[j] > upper[j] + small, y[j] < lower[j] - small
        over = abs(lam[j]) > (1.0 + slip) * w[j]
        inwards = lam[j] * code[j] < -slip * (1.0 + abs(lam[j]))
        if over or inwards or ((above or below) and abs(code[j]) < 2):
            contradicted = True
        if code[j] == 0:
            code[j] = 1 if above else -1 if below else 0
        elif abs(code[j]) == 2:
            # A saturated row that is back within its bounds is held.
            if y[j] < upper[j] - small if code[j] > 0 else y[j] > lower[j] + small:
                code[j] //= 2
        elif over:
            code[j] = 2 if lam[j] > 0 else -2
        elif inwards and lower[j] < upper[j]:
            # One whose multiplier pulls inwards is let go, unless both its bounds are one.
            code[j] = 0
    return contradicted
