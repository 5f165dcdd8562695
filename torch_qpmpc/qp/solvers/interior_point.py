"""A primal-dual interior-point method for whole batches, in torch, the same on CPU and GPU.

The soft rows need no slack variables. Each side of a row, ``y <= u`` and ``l <= y``, has a distance
s, an excess t, a multiplier lam, and the rest mu of its weight:

    u - y = s - t,     s lam = 0,     t mu = 0,     lam + mu = w,     s, t, lam, mu >= 0.

Mehrotra's method (1992, doi:10.1137/0802028) reduces both products together. Eliminating them side
by side leaves ``(H + G'DG) dv = right`` with the diagonal ``1 / D = s / lam + t / mu``: an
iteration costs one batched product and one d x d Cholesky factor, used twice. Infinite weights and
bounds are huge numbers, whose pairs are inert; a hard equality, which has no interior, has a
penalty and a multiplier of its own. Nothing loops over the batch. From the active set that it
finds early, `torch_qpmpc.qp.kernels.active_set` goes on. Where the elimination leaves that too few
digits, `_settled` solves for the set.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.qp.kernels.batched import largest
from torch_qpmpc.qp.pipeline.arrays import BackendSolution, SoftQPs

#: The largest absolute entry along the last dimension, which is kept.
_largest = partial(largest, keepdim=True)
#: Replaces infinity: its reciprocal vanishes in sums, and its square does not overflow.
HUGE = 1e100
#: A row up to this narrow, relative to its larger bound, counts as an equality.
NARROW = 1e-6
#: Bounds are far apart if wider than this many times the typical bound or unconstrained optimum, ..
WIDE = 1e3
#: .. and a bound beyond this many times that does not act.
FAR = 1e8
#: A typical multiplier, relative to the largest force.
TYPICAL = 0.05
#: Least typical curvature, relative to the largest force over a length.
FLAT = 1e-2
#: Curvatures that hold a row at its bound and damp every step, relative to the typical one.
PENALTY, DAMPING = 1e10, 1e-10
#: Added to a matrix that is indefinite by rounding, relative to its largest diagonal entry.
ROUNDING = 1e-12
#: Gaps, relative to a typical cost, that show an active set, and that end the method.
EARLY, MIDDLE, LAST = 1e-4, 1e-8, 1e-12
#: The most iterations; and steps on active sets, with passes of the method of multipliers in each.
LIMIT, SETTLING, MULTIPLIER_PASSES = 65, 3, 3
#: Largest step, relative to that to the boundary.
STEP = 0.995
#: The initial distance of a side is at least this fraction of the row's width, ..
ROOM = 0.25
#: .. but exact for soft sides of a QP with a row violated by more than this fraction.
MILD = 0.3
#: After this many steps, which may be cycling, the target is at least this fraction of the gap.
LATE, CAUTION = 20, 0.3
#: Solved QPs are removed from the computation if at most this fraction is unsolved.
SHRINK = 0.75


class BatchedQPs(NamedTuple):
    """`SoftQPs` with `HUGE` for infinity, and typical sizes.

    H and G are ``(1, ..)`` if the batch shares them, and ``products`` then holds the outer products
    of G's rows, ``(r, d d)``; else they are ``(B, ..)``. Typical sizes make all decisions
    independent of units: the ``width`` between a row's bounds, the ``force`` of its multiplier, the
    ``penalty`` that holds it, ``(B, r)``; the ``cost``, or least width times force, and the
    ``curvature``, ``(B,)``.
    """

    H: Tensor
    G: Tensor
    products: Tensor | None
    g: Tensor
    lower: Tensor
    upper: Tensor
    w: Tensor
    width: Tensor
    force: Tensor
    penalty: Tensor
    cost: Tensor
    curvature: Tensor

    @classmethod
    def of(cls, qps: SoftQPs) -> BatchedQPs:
        H, G, g, products = qps.H, qps.G, qps.g, None
        if len(H) == 1:
            products = (G[0].unsqueeze(-1) * G[0].unsqueeze(-2)).flatten(1)
        else:
            H, G = H[qps.group], G[qps.group]
        lower, upper, w = qps.l.clamp(min=-HUGE), qps.u.clamp(max=HUGE), qps.w.clamp(max=HUGE)
        size = _largest(G).squeeze(-1)
        size = torch.where(size > 1 / HUGE, size, 1.0)
        stiffest = _largest(H.flatten(1))
        near = lower.abs().minimum(upper.abs()) / size
        near = near.masked_fill(~((near > 0) & (near < 1e-10 * HUGE)), torch.nan)
        near = near.nanmedian(-1, keepdim=True).values.nan_to_num(1.0)
        near = near.maximum((_largest(g) / stiffest).nan_to_num(0.0, 0.0))
        far = FAR * size * near
        lower, upper = lower.where(lower >= -far, -HUGE), upper.where(upper <= far, HUGE)
        width = (upper - lower) / size
        narrow = upper - lower <= NARROW * lower.abs().maximum(upper.abs())
        known = ~narrow & (width < WIDE * near)
        median = width.masked_fill(~known, torch.nan).nanmedian(-1, keepdim=True).values
        median = median.nan_to_num(1.0)
        width = torch.where(known, width, median).maximum(1e-3 * median)
        length = width.amin(-1, keepdim=True)
        force = _largest(g) + stiffest * length
        force = torch.where(force > 0, force, 1.0)
        curvature = stiffest.maximum(FLAT * force / length)
        width, force = width * size, TYPICAL * force / size
        penalty, cost = PENALTY * curvature / size.square(), (force * width).amin(-1)
        curvature = curvature.squeeze(-1)
        return cls(H, G, products, g, lower, upper, w, width, force, penalty, cost, curvature)

    def take(self, index: Tensor) -> BatchedQPs:
        """Return the QPs at ``index``."""
        same = ("H", "G", "products") if self.products is not None else ("products",)
        pairs = self._asdict().items()
        return BatchedQPs(**{n: x if n in same else x[index] for n, x in pairs})

    def factor(self, weight: Tensor) -> Tensor:
        """Return Cholesky factors of ``H + G' diag(weight) G``, slightly damped, ``(B, d, d)``."""
        if self.products is not None:
            normal = torch.addmm(self.H.flatten(1), weight, self.products)
            normal = normal.unflatten(1, self.H.shape[1:])
        else:
            normal = torch.baddbmm(self.H, (self.G * weight.unsqueeze(-1)).mT, self.G)
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        diagonal += DAMPING * self.curvature.unsqueeze(-1)
        factor, info = torch.linalg.cholesky_ex(normal)
        if (failed := info > 0).any():
            diagonal += ROUNDING * diagonal.amax(-1, keepdim=True)
            factor[failed] = torch.linalg.cholesky_ex(normal[failed])[0]
        return factor

    def times(self, matrices: Tensor, vectors: Tensor) -> Tensor:
        """Multiply the QPs' matrices by ``(B, j)``, to ``(B, i)``."""
        if self.products is not None:
            return vectors @ matrices[0].mT
        return torch.bmm(matrices, vectors.unsqueeze(-1)).squeeze(-1)


@torch.no_grad()
def solve(
    qps: SoftQPs, device: torch.device | str = "cpu", target: float = LAST, steps: int = 0
) -> BackendSolution:
    """Solve a batch of arrays on a device; take ``steps`` on active sets at the end.

    Infeasible and unbounded QPs have finite results, which the certificate rejects.
    """
    form = BatchedQPs.of(SoftQPs._make(torch.from_numpy(x).to(device) for x in qps))
    point = _begin(form)
    _follow(form, point, target)
    v, lam = point.v, point.lam
    for _ in range(steps):
        v, lam = _settled(form, v, lam)
    return BackendSolution._make(x.numpy(force=True) for x in (v, lam, point.steps))


def _settled(qps: BatchedQPs, v: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Return v and lam with active rows at their bounds, and fixed lam in the others.

    The KKT conditions are then linear, and the method of multipliers solves them: a large curvature
    holds the active rows, even dependent ones, and each pass reduces its error.
    """
    y, G_t, stiffness = qps.times(qps.G, v), qps.G.mT, qps.force / qps.width
    p, limit = y + lam / stiffness, qps.w / stiffness
    nearest = p.clip(qps.lower, qps.upper)
    excess = p - nearest
    active = (excess.abs() <= limit) & ((excess != 0) | (qps.lower == qps.upper))
    lam = torch.where(active, lam, excess.clip(-limit, limit) * stiffness)
    weight = active * qps.penalty
    factor = qps.factor(weight)
    for _ in range(MULTIPLIER_PASSES):
        short = nearest - y
        right = qps.times(G_t, weight * short - lam) - qps.times(qps.H, v) - qps.g
        dv = torch.cholesky_solve(right.unsqueeze(-1), factor).squeeze(-1)
        dy = qps.times(qps.G, dv)
        v, y, lam = v + dv, y + dy, lam + weight * (dy - short)
    return v, lam


class Point(NamedTuple):
    """The current iterates of a batch.

    v ``(B, d)``; ``primal`` and ``dual``, the pairs ``(B, 2, 2, r)`` of (s, t) with (lam, mu) for
    (upper, lower) sides, with signs that make all formulas the same (see `_begin`), and the sides'
    ``bound`` ``(B, 2, r)``. Hard equalities, ``y = level``, have the penalty ``hold`` and the
    multiplier ``equality``, ``(B, r)``, zero in other rows. ``astray`` is the remaining fraction of
    the initial error in the linear equations, ``steps`` the number of iterations, and ``lost`` True
    where arithmetic failed, ``(B,)``.
    """

    v: Tensor
    primal: Tensor
    dual: Tensor
    bound: Tensor
    level: Tensor
    hold: Tensor
    equality: Tensor
    astray: Tensor
    steps: Tensor
    lost: Tensor

    @property
    def lam(self) -> Tensor:
        """Multipliers of the rows, ``(B, r)``, positive at the upper bound."""
        return self.dual[:, 0].sum(1) + self.equality

    def take(self, index: Tensor) -> Point:
        """Return a copy of the points at ``index``."""
        return Point._make(x[index] for x in self)

    def put(self, index: Tensor, other: Point) -> None:
        """Replace the points at ``index``."""
        for own, new in zip(self, other, strict=True):
            own[index] = new


def _begin(qps: BatchedQPs) -> Point:
    """Return the start: v = 0, and s, t, lam and mu with equal products.

    Upper sides store (s, -t) and (lam, -mu), lower ones (-s, t) and (-lam, mu): then ``bound - y``
    is the sum of the first pair on either side, a step in lam adds to all four duals, and the
    products and ratios of the pairs are positive.
    """
    dead, equal = qps.w == 0, (qps.lower == qps.upper) & (qps.w == HUGE)
    bound = torch.stack((qps.upper, qps.lower), 1)
    sign = torch.tensor([[1.0], [-1.0]], dtype=bound.dtype, device=bound.device)
    bound = torch.where((dead | equal).unsqueeze(1), sign * HUGE, bound)
    cap = qps.w.masked_fill(dead, 1).unsqueeze(1)
    hard, room, width = cap == HUGE, sign * bound, qps.width.unsqueeze(1)
    short = (-room).clamp(min=0)
    mild = (short <= MILD * width).all(-1).all(-1)[:, None, None]
    charge = torch.where(hard, qps.force.unsqueeze(1), cap) * short
    product = qps.cost[:, None, None] + charge.amax((1, 2), keepdim=True) * ~mild
    room = torch.where(mild | hard, room.maximum(ROOM * width), room)
    # The solution of s - t = room and s lam = t (w - lam) = product, without cancellation.
    offset = product / cap
    root = torch.hypot(room, 2 * offset)
    s, t = (root + room) / 2 + offset, (root - room) / 2 + offset
    primal = torch.stack((sign * s, -sign * t), 1)
    return Point(
        v=torch.zeros_like(qps.g),
        primal=primal,
        dual=product.unsqueeze(1) / primal,
        bound=bound,
        level=torch.where(equal, qps.lower, 0),
        hold=qps.penalty * equal,
        equality=torch.zeros_like(qps.w),
        astray=torch.ones_like(qps.cost),
        steps=torch.zeros_like(qps.cost, dtype=torch.int64),
        lost=torch.zeros_like(qps.cost, dtype=torch.bool),
    )


def _follow(qps: BatchedQPs, end: Point, target: float) -> None:
    """Iterate ``end`` in place until its gaps are below ``target``, at most `LIMIT` times."""
    todo, point = torch.arange(len(qps.g), device=end.v.device), end
    for _ in range(LIMIT):
        products = point.primal * point.dual
        gap = products.sum((1, 2, 3))
        going = ((gap > target * qps.cost) | (point.astray > target)) & ~point.lost
        count = int(going.sum())
        if not count:
            break
        if count <= SHRINK * len(todo):
            if point is not end:
                end.put(todo, point)
            index = going.nonzero().squeeze(-1)
            qps, point, todo = qps.take(index), point.take(index), todo[index]
            products, gap, going = products[index], gap[index], going[index]
        _step(qps, point, products, gap, going)
    if point is not end:
        end.put(todo, point)


def _step(qps: BatchedQPs, point: Point, products: Tensor, gap: Tensor, going: Tensor) -> None:
    """Do one iteration of Mehrotra's method in place, for the QPs in the mask ``going``."""
    v, primal, dual, hold = point.v, point.primal, point.dual, point.hold
    y, G_t, inverse = qps.times(qps.G, v), qps.G.mT, dual.reciprocal()
    ratio = primal * inverse
    D = ratio.sum(1).reciprocal_().minimum(qps.penalty.unsqueeze(1))
    factor = qps.factor(D.sum(1) + hold)
    short = point.level - y
    pull = DAMPING * qps.curvature.unsqueeze(-1) * v
    right = qps.times(G_t, hold * short - point.lam) - qps.times(qps.H, v) - qps.g - pull
    room = point.bound - y.unsqueeze(1)

    def direction(offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return dv, dy = G dv and dlam = D (dy - offset), which solve the Newton equations."""
        total = right + qps.times(G_t, (D * offset).sum(1))
        dv = torch.cholesky_solve(total.unsqueeze(-1), factor).squeeze(-1)
        dy = qps.times(qps.G, dv)
        return dv, dy, (dy.unsqueeze(1) - offset).mul_(D).unsqueeze(1)

    # The predictor's target is zero products. Its step length determines the corrector's target.
    _, _, dlam = direction(room)
    relative = inverse * dlam
    low, high = relative.flatten(1).amin(1), relative.flatten(1).amax(1)
    reach = torch.maximum(1 + high, -low).clamp(min=1).reciprocal()
    second = relative.addcmul_(relative, relative)
    left = (1 - reach) * gap - reach.square() * products.mul_(second).sum((1, 2, 3))
    share = ((left / gap).clamp(0, 1) ** 3).maximum(CAUTION * (point.steps > LATE))
    centre = share * gap / products[0].numel()

    # The corrector's target is products of ``centre``, with the predictor's second-order term.
    goal = second.mul_(primal).addcmul_(inverse, centre[:, None, None, None])
    dv, dy, dlam = direction(room - goal.sum(1))
    change = goal.sub_(primal).addcmul_(ratio, dlam, value=-1)
    ends = (change / primal).flatten(1).amin(1), inverse.mul_(dlam).flatten(1).amin(1)
    ahead = STEP / -torch.minimum(*ends).clamp(max=-STEP)
    failed = ~ahead.isfinite()
    if failed.any():
        point.lost.logical_or_(failed)
        for x in (dv, dy, dlam, change, ahead):
            x[failed] = 0
    ahead *= going
    v.addcmul_(ahead[:, None], dv)
    primal.addcmul_(ahead[:, None, None, None], change)
    dual.addcmul_(ahead[:, None, None, None], dlam)
    point.equality.addcmul_(ahead[:, None], hold * (dy - short))
    point.astray.mul_(1 - ahead)
    point.steps.add_(going)
