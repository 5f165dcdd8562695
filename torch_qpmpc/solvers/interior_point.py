"""A primal-dual interior point for a whole batch, in pure torch: the same code on CPU and GPU.

Each side of a soft row, ``y <= u`` or ``-y <= -l``, has a distance s, an excess t, and multipliers
in pairs with them:

    s = bound - y + t,     s lam = 0,     t mu = 0,     mu = w - lam,     all four non-negative.

Mehrotra's predictor and corrector solve this with both products set to a shrinking target. The
elimination of s, t, lam and mu row by row leaves ``(H + G'DG) dv = right`` with the diagonal
``1 / D = s / lam + t / mu``: no slack variables, one Cholesky factor of d x d an iteration.

An infinite w or bound becomes a huge one, which makes its pair inert; a hard equality, which has no
interior, is held by a penalty and a multiplier of its own. At the end the active set is read off
and solved for exactly (`active_set`); it is also how a warm start begins.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torch_qpmpc.condense import SoftQPs
from torch_qpmpc.solvers.active_set import SETTLED, Found, settle
from torch_qpmpc.solvers.answer import Answer
from torch_qpmpc.solvers.batched import HUGE, BatchedQPs

#: The relative duality gaps at which the active set is tried, and the iterations spent to get there.
TARGETS = ((1e-4, 40), (1e-8, 15), (1e-12, 10))
WARM_STEPS, LAST_STEPS = 5, 3
#: The fraction of the way to the boundary that a step may go.
STEP = 0.995
#: Distances begin at no less than this fraction of a row's width, ..
ROOM = 0.25
#: .. unless a soft row is violated by more than this many widths: then at a strictly feasible point.
MILD = 0.3
GIVE = 1e-2
#: Solved QPs leave the computation once this fraction or less is unsolved.
SHRINK = 0.75


def solve(qps: SoftQPs, start: Answer | None = None) -> Answer:
    """Solve a batch; ``start`` is a primal-dual guess, whose active set is tried first."""
    arrays = (qps.H, qps.G, qps.group, qps.g, qps.l, qps.u, qps.w)
    H, G, group, g, l, u, w = (torch.from_numpy(array) for array in arrays)
    guess = None if start is None else (torch.from_numpy(start.v), torch.from_numpy(start.lam))
    v, lam, iterations = interior_point(H, G, group, g, l, u, w, guess)
    return Answer(v.numpy(), lam.numpy(), iterations.numpy())


@torch.no_grad()
def interior_point(
    H: Tensor,
    G: Tensor,
    group: Tensor,
    g: Tensor,
    l: Tensor,
    u: Tensor,
    w: Tensor,
    start: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """v ``(B, d)``, lam ``(B, r)`` and iterations ``(B,)`` for the tensors of `SoftQPs`.

    All on one device, float64. An answer is finite, but need not be a solution: infeasible and
    unbounded QPs end with what the last iteration left.
    """
    qps = BatchedQPs.of(H, G, group, g, l, u, w)
    todo = torch.arange(len(qps), device=g.device)
    nothing = torch.full_like(g[:, 0], torch.inf)
    found = Found(torch.zeros_like(g), torch.zeros_like(l), nothing, torch.zeros_like(todo))
    if start is not None:
        found = settle(qps, *start, WARM_STEPS)
        todo = (~(found.residual <= SETTLED)).nonzero().squeeze(-1)
    part = qps.take(todo)
    point = _begin(part)
    for target, limit in TARGETS:
        if not len(todo):
            break
        steps = _follow(part, point, target, limit)
        exact = settle(part, point.v, point.lam, LAST_STEPS)
        found.offer(todo, exact.v, exact.lam, exact.residual)
        found.steps[todo] += steps + exact.steps
        going = ~(exact.residual <= SETTLED)
        part, point, todo = part.take(going), point.take(going), todo[going]
    return found.v, found.lam, found.steps


@dataclass
class Point:
    """Where an interior point is.

    v ``(B, d)``; ``primal`` and ``dual``, the pairs ``(B, 2, 2, r)`` of (s, t) with (lam, mu), the
    upper and the lower side in the third place; ``bound`` ``(B, 2, r)`` of these sides. Their signs
    (see `_begin`) make one formula serve all. Hard equalities, ``y = level``, have the penalty
    ``hold`` and the multiplier ``equality``, ``(B, r)``, zero in other rows. ``astray`` ``(B,)`` is
    what is left of the initial violation of the linear equations.
    """

    v: Tensor
    primal: Tensor
    dual: Tensor
    bound: Tensor
    level: Tensor
    hold: Tensor
    equality: Tensor
    astray: Tensor

    @property
    def lam(self) -> Tensor:
        """Multipliers of the rows, ``(B, r)``, positive at the upper bound."""
        return self.dual[:, 0].sum(1) + self.equality

    def take(self, index: Tensor) -> Point:
        """A copy of the points at ``index``."""
        return Point(*(getattr(self, field.name)[index] for field in fields(self)))

    def put(self, index: Tensor, other: Point) -> None:
        for field in fields(self):
            getattr(self, field.name)[index] = getattr(other, field.name)


def _begin(qps: BatchedQPs) -> Point:
    """v = 0, and s, t, lam and mu such that all products are equal.

    Stored are (s, -t) with (lam, -mu) for upper sides and (-s, t) with (-lam, mu) for lower ones:
    then ``bound - y`` is the sum of each first pair, and a step in y changes all duals alike.
    """
    dead, equal = qps.w == 0, (qps.l == qps.u) & (qps.w == HUGE)
    bound = torch.stack((qps.u, qps.l), 1)
    sign = torch.tensor([[1.0], [-1.0]], dtype=bound.dtype, device=bound.device)
    bound = torch.where((dead | equal).unsqueeze(1), sign * HUGE, bound)
    cap = qps.w.masked_fill(dead, 1).unsqueeze(1)
    width, force, room = qps.width.unsqueeze(1), qps.force.unsqueeze(1), sign * bound
    short = (-room).clamp(min=0)
    mild = (short <= MILD * width).all(-1).all(-1)[:, None, None]
    charge = (torch.where(cap < HUGE, cap, force) * short).amax((1, 2), keepdim=True)
    product = qps.cost[:, None, None] + torch.where(mild, 0, charge)
    # Where s - t = room and s lam = t (w - lam) = product, in a form that does not cancel.
    room = torch.where(mild | (cap == HUGE), room.maximum(ROOM * width), room)
    offset = product / cap
    root = torch.hypot(room, 2 * offset)
    s, t = (root + room) / 2 + offset, (root - room) / 2 + offset
    primal = torch.stack((sign * s, -sign * t), 1)
    return Point(
        v=torch.zeros_like(qps.g),
        primal=primal,
        dual=product.unsqueeze(1) / primal,
        bound=bound,
        level=torch.where(equal, qps.l, 0),
        hold=torch.where(equal, qps.penalty, 0),
        equality=torch.zeros_like(qps.l),
        astray=torch.ones_like(qps.cost),
    )


def _follow(qps: BatchedQPs, end: Point, target: float, limit: int) -> Tensor:
    """Move ``end`` until the gap is below ``target``, and return the iterations spent, ``(B,)``."""
    pairs = 4 * qps.l.shape[-1]
    todo, point = torch.arange(len(qps), device=end.v.device), end
    iterations, lost = torch.zeros_like(todo), torch.zeros_like(todo, dtype=torch.bool)
    for _ in range(limit):
        v, primal, dual = point.v, point.primal, point.dual
        products = primal * dual
        gap = products.sum((1, 2, 3))
        going = ~((gap <= target * qps.cost) & (point.astray <= target) | lost)
        count = int(going.sum())
        if not count:
            break
        if count <= SHRINK * len(todo):
            if point is not end:
                end.put(todo, point)
            qps, point, todo, lost = qps.take(going), point.take(going), todo[going], lost[going]
            continue
        iterations[todo] += going

        inverse, y = dual.reciprocal(), qps.rows(v)
        ratio = primal * inverse
        D = (ratio.sum(1) + GIVE / qps.penalty.unsqueeze(1)).reciprocal()
        factor = qps.factor(D.sum(1) + point.hold)
        held = point.hold * (point.level - y)
        right = qps.pull(held - point.lam) - qps.bend(v) - qps.g
        room = point.bound - y.unsqueeze(1)

        # Predictor: how far a step to products of zero would lead tells what to aim at.
        _, _, dlam = _direction(qps, factor, D, right, room)
        relative = inverse * dlam.unsqueeze(1)
        low, high = relative.flatten(1).amin(1), relative.flatten(1).amax(1)
        reach = torch.maximum(1 + high, -low).clamp(min=1).reciprocal()
        second = relative.addcmul_(relative, relative)
        left = (1 - reach) * gap - reach.square() * products.mul_(second).sum((1, 2, 3))
        centre = (left / gap).clamp(0, 1) ** 3 * gap / pairs

        # Corrector: to products of ``centre``, with the predictor's second-order term.
        goal = second.mul_(primal).addcmul_(inverse, centre[:, None, None, None])
        dv, dy, dlam = _direction(qps, factor, D, right, room - goal.sum(1))
        d_dual = dlam.unsqueeze(1)
        d_primal = goal.sub_(primal).addcmul_(ratio, d_dual, value=-1)
        d_equality = point.hold * dy - held
        low = torch.minimum(
            (d_primal / primal).flatten(1).amin(1), inverse.mul_(d_dual).flatten(1).amin(1)
        )
        if not (finite := low.isfinite()).all():
            lost |= ~finite
            for step in (dv, d_primal, d_dual, d_equality, low):
                step[~finite] = 0
        alpha = STEP / (-low).clamp(min=STEP) * (going & ~lost)
        v.addcmul_(alpha[:, None], dv)
        primal.addcmul_(alpha[:, None, None, None], d_primal)
        dual.addcmul_(alpha[:, None, None, None], d_dual)
        point.equality.addcmul_(alpha[:, None], d_equality)
        point.astray.mul_(1 - alpha)
    if point is not end:
        end.put(todo, point)
    return iterations


def _direction(
    qps: BatchedQPs, factor: Tensor, D: Tensor, right: Tensor, offset: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """dv, dy = G dv, and the sides' dlam = D (dy - offset), from the factor of ``H + G'DG``."""
    toward = qps.pull((D * offset).sum(1)).add_(right)
    dv = torch.cholesky_solve(toward.unsqueeze(-1), factor).squeeze(-1)
    dy = qps.rows(dv)
    return dv, dy, (dy.unsqueeze(1) - offset).mul_(D)
