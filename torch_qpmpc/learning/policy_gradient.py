"""Policy improvement: a compatible deterministic policy gradient through the QP's solution.

The critic of a visited pair is Q(s, a) = V(s) + R(s) + A(s, a). V is the QP's. The advantage is
linear in the policy's sensitivities, which makes it compatible (Silver et al. 2014; Gros and Zanon
2020),

    A(s, a) = w'psi,   psi = M(s)'(a - pi(s)),   M(s) = dpi(s)/dtheta,

and w is then the natural gradient of the closed loop's cost: the gradient in theta is F w, with
F = E[M'M] the Fisher matrix of Gaussian exploration. R is a correction of V, without which V's
error at s+, that depends on a, would pass for an advantage: it is linear in the entries of the
window and their squares. Least-squares TD with a ridge fits both to the one-step errors

    delta = L + gamma V(s+) - V(s) = w'psi + R(s) - gamma R(s+) + noise.

Signals that are known ahead of time do not depend on a: those in p, and the new ones in p+, are
further regressors, which take their share of the noise out of delta.

A is linear in a, so that w has no length of its own. The step is bounded in the policy instead:

    dtheta = -rate share rms(a - pi) w / sqrt(w'F w)

changes the actions by at most the fraction ``rate`` of the exploration, in root mean square, a
trust region in the metric F. ``share`` is 1 minus the part of w'F w that noise alone would explain,
at least 0 (James and Stein): a w within its noise moves nothing.

The actions hardly depend on the bounds and slack weights of rows that are rarely active, so that a
step bounded in the actions is not bounded in these. A bound or slack weight moves only if a change
by its whole size changes the actions by more than a hundredth of the exploration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_number, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.learning.pairs import usable
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.solution import QPSolution

#: Parts of theta with sensitivities for each QP of a batch at hardly any extra cost.
PARTS = ("q", "b", "lb", "ub", "w")
#: Smallest size of a feature, relative to the largest of its part, that counts.
FLOOR = 1e-6
#: A bound or slack weight stays if a change by its whole size changes the actions by less than this
#: fraction of the exploration.
WEAK = 1e-2


@dataclass(frozen=True)
class PolicyStep:
    """The outcome of a `PolicyGradient.step`.

    Attributes:
        w: the weights of the advantage by part, before the step.
        share: the part of w that noise does not explain, in [0, 1].
        change: root mean square of the actions' change at first order, over that of a - pi(s).
        unsolved: number of pairs left out because their QP has no solution.
        without_target: number of other pairs left out because their target is not finite.
    """

    w: dict[str, Tensor]
    share: float
    change: float
    unsolved: int = 0
    without_target: int = 0


def policy_sensitivities(
    mpc: QPMPC, s: Tensor, parts: Sequence[str], warm_start: Tensor | None = None
) -> tuple[QPSolution, Tensor]:
    """Return the solution of V(s), and dpi/dtheta ``(B, n_u, n)`` in the coordinates of ``parts``.

    The parts are side by side, in their order. Each QP of the batch has its own copy of them, so
    that one backward pass for each entry of the action suffices. A QP without a solution has zeros.

    Args:
        mpc: the QPMPC.
        s: p of each QP, ``(B, n_p)``.
        parts: names among ``PARTS``.
        warm_start: active sets to start from, ``(B, n_g)``.

    Raises:
        QPError, SolverError: as in `QPMPC.solve`.
    """
    theta = mpc.coordinates()
    copies = {x: theta[x].new_zeros(len(s), *theta[x].shape).requires_grad_() for x in parts}
    with torch.enable_grad():
        solution = mpc.solve(s, warm_start=warm_start, qp=mpc.quadratic_program(copies))
        action = solution.z[:, mpc.n_p : mpc.n_p + mpc.n_u]
        action = torch.where(solution.solved.unsqueeze(-1), action, 0)
        rows = []
        for entry in action.sum(0):
            found = torch.autograd.grad(entry, list(copies.values()), retain_graph=True)
            rows.append(torch.cat([x.flatten(1) for x in found], -1))
    return solution, torch.stack(rows, 1)


class PolicyGradient:
    """Moves some parts of theta along the natural policy gradient of a compatible advantage.

    It freezes these parts, so that no optimiser of TD errors moves them. Bounds of hard rows stay.

    Args:
        mpc: the QPMPC. With ``on_failure="mask"``, pairs without a solution are left out.
        parts: names among q, b, lb, ub and w, which ``mpc`` learns.
        rate: the largest change of the actions in one step, in root mean square, as a fraction of
            the exploration.
        ridge: the ridge of the regression, relative to the mean square of each regressor.
        memory: number of past pairs that each regression keeps, with the sensitivities and errors
            of their time. It serves small batches from a stream; a replay needs none.

    Raises:
        QPError: an argument is invalid.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from torch_qpmpc.learning.policy_gradient import PolicyGradient
        >>> mpc = qm.QPMPC(1, 1, 3, learn=("c", "b"), A=[[1.0]], B=[[1.0]], solver="daqp")
        >>> improve = PolicyGradient(mpc, ["b"])
        >>> s = torch.randn(64, 1, dtype=torch.float64)
        >>> a = mpc.policy(s).detach() + 0.1 * torch.randn(64, 1, dtype=torch.float64)
        >>> target = mpc.value(s).detach() + a[:, 0]  # larger actions cost more
        >>> before = mpc.policy(s).detach()
        >>> report = improve.step(s, a, target)
        >>> bool((mpc.policy(s) < before).all())
        True
    """

    def __init__(
        self,
        mpc: QPMPC,
        parts: Sequence[str],
        *,
        rate: float = 0.05,
        ridge: float = 0.01,
        memory: int = 0,
    ) -> None:
        check_kind("mpc", mpc, QPMPC)
        check_number("rate", rate, lambda x: 0 < x < math.inf, "a finite number > 0")
        check_number("ridge", ridge, lambda x: 0 < x < math.inf, "a finite number > 0")
        check_whole("memory", memory, 0)
        if not parts or set(parts) - set(PARTS) or len(set(parts)) < len(parts):
            raise QPError.expected("parts", repr(parts), f"different names of {', '.join(PARTS)}")
        for leaf in [leaf for part in parts for leaf in mpc.leaves(part)]:
            leaf.requires_grad_(False)
        self.parts, self.rate, self.ridge, self.memory = tuple(parts), rate, ridge, memory
        self._mpc = mpc
        self._past: tuple[Tensor, ...] | None = None

    @torch.no_grad()
    def step(
        self,
        s: Tensor,
        a: Tensor,
        target: Tensor,
        *,
        following: Tensor | None = None,
        discount: Tensor | float = 1.0,
        warm_start: Tensor | None = None,
        share_of_rate: float = 1.0,
    ) -> PolicyStep:
        """Estimate w from a batch, and take a step.

        Args:
            s, a: visited pairs, ``(B, n_p)`` and ``(B, n_u)``, with actions that explore.
            target: costs to go, L + gamma V(s+), ``(B,)``. Pairs with a target that is not finite
                are left out and counted. Negate rewards and TorchRL's values.
            following: p of s+, ``(B, n_p)``; without it, R is a baseline of delta alone, which
                suits a V without errors.
            discount: gamma, or gamma (1 - terminated) ``(B,)``; not used without ``following``.
            warm_start: active sets of V(s) to start from, ``(B, n_g)``.
            share_of_rate: the fraction of ``rate`` of this step, as from a schedule.

        Returns:
            The outcome; without a usable pair theta and the memory stay, with a `RuntimeWarning`.

        Raises:
            QPError: a shape does not fit.
        """
        mpc = self._mpc
        check_tensor("s", s, "B", mpc.n_p, batched=False)
        check_tensor("a", a, len(s), mpc.n_u, batched=False)
        check_tensor("target", target, len(s), batched=False, remedy="Squeeze its last dimension.")
        gamma = torch.as_tensor(discount).to(mpc.C_0)
        if gamma.ndim:
            remedy = "Squeeze its last dimension."
            check_tensor("discount", gamma, len(s), batched=False, remedy=remedy)
        gamma = gamma.expand(len(s))
        if following is None:
            following, gamma = torch.zeros_like(s), torch.zeros_like(gamma)
        check_tensor("following", following, len(s), mpc.n_p, batched=False)
        solution, M = policy_sensitivities(mpc, s, self.parts, warm_start)
        M = M * self._movable()
        use, left_out = usable(solution.solved, target)
        if sum(left_out) == len(s):
            return PolicyStep({}, 0.0, 0.0, *left_out)
        delta = (target.to(solution.value) - solution.value)[use]
        explored = (a.to(solution.z) - solution.z[:, mpc.n_p : mpc.n_p + mpc.n_u])[use]
        # What follows a termination has no value, and may be NaN.
        following = torch.where(gamma.unsqueeze(-1) > 0, following, 0)
        known = (x[use].to(delta) for x in (s, following, gamma))
        rows = self._with_past((M[use], explored, delta, *known))
        M, explored = rows[:2]
        w, share = self._weights(*rows)
        change = (M @ w).square().sum(-1).mean().sqrt()
        length = self.rate * share_of_rate * share
        if not change > 0 or not w.isfinite().all():
            length, step = 0.0, torch.zeros_like(w)
        else:
            step = -length * explored.square().sum(-1).mean().sqrt() / change * w
        theta, sizes = mpc.coordinates(), self._sizes()
        for part, move in zip(self.parts, step.split(sizes), strict=True):
            theta[part].add_(move.view_as(theta[part]))
        mpc.project_()
        pieces = zip(self.parts, w.split(sizes), strict=True)
        found = {part: x.view_as(theta[part]) for part, x in pieces}
        return PolicyStep(found, share, length, *left_out)

    def _sizes(self) -> list[int]:
        """Return the number of coordinates of each part."""
        theta = self._mpc.coordinates()
        return [theta[part].numel() for part in self.parts]

    def _magnitudes(self) -> Tensor:
        """Return the size of each coordinate: infinite for q and b, which may well be zero."""
        mpc, theta = self._mpc, self._mpc.coordinates()
        bounds = torch.cat((mpc.lb[mpc.soft], mpc.ub[mpc.soft]))
        found = []
        for part in self.parts:
            sizes = {"w": theta[part], "lb": bounds, "ub": bounds}.get(part)
            size = torch.inf if sizes is None else _rms(sizes[sizes.isfinite()])
            found.append(torch.full_like(theta[part], size).flatten())
        return torch.cat(found)

    def _movable(self) -> Tensor:
        """Return 0 at the bounds of hard rows, else 1, side by side for all parts."""
        theta, soft = self._mpc.coordinates(), self._mpc.soft
        found = []
        for part in self.parts:
            bounds = part in ("lb", "ub") and theta[part].shape == soft.shape
            found.append(soft if bounds else torch.ones_like(theta[part], dtype=torch.bool))
        return torch.cat(found).to(self._mpc.C_0)

    def _with_past(self, rows: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Append the remembered rows to new ones, and remember the newest."""
        if self._past is not None:
            rows = tuple(map(torch.cat, zip(rows, self._past, strict=True)))
        self._past = tuple(x[: self.memory] for x in rows) if self.memory else None
        return rows

    def _weights(
        self,
        M: Tensor,
        explored: Tensor,
        delta: Tensor,
        s: Tensor,
        following: Tensor,
        discount: Tensor,
    ) -> tuple[Tensor, float]:
        """Return w by least-squares TD, and the share of it that noise does not explain."""
        psi = (M * explored.unsqueeze(-1)).sum(1)
        n, size = psi.shape
        scale = psi.square().mean(0).sqrt()
        effect = M.square().mean((0, 1)).sqrt() * self._magnitudes()
        scale = torch.where(effect > WEAK * explored.square().mean().sqrt(), scale, 0.0)
        largest = [part.max().expand(len(part)) for part in scale.split(self._sizes())]
        scale = torch.where(scale > FLOOR * torch.cat(largest), scale, torch.inf)
        before, after = self._features(s, following)
        # R's constant; without discount and ends, the mean of delta.
        one, constant = torch.ones_like(delta), 1 - discount
        constant = constant / constant.mean() if constant.mean() > FLOOR else one
        X = torch.cat((psi / scale, before, one.unsqueeze(-1)), 1)
        R = before - discount.unsqueeze(-1) * after
        Y = torch.cat((psi / scale, R, constant.unsqueeze(-1)), 1)
        penalty = self.ridge * n * torch.eye(X.shape[1]).to(X)
        penalty[-1, -1] = 0
        moment = X.mT @ Y
        inverse = torch.linalg.inv_ex(moment + penalty).inverse
        found = inverse @ (X.mT @ delta)
        freedom = float((inverse * moment.mT).sum())
        noise = (delta - Y @ found).square().sum() / max(n - freedom, 1.0)
        covariance = noise * (inverse @ (X.mT @ X) @ inverse.mT)[:size, :size]
        # w'F w, and its mean if w were noise alone.
        scaled = (M / scale).flatten(0, 1)
        fisher = scaled.mT @ scaled / n
        size_of_w = found[:size] @ fisher @ found[:size]
        by_noise = (covariance * fisher).sum()
        share = float((1 - by_noise / size_of_w).clamp(min=0)) if size_of_w > 0 else 0.0
        return found[:size] / scale, share

    def _features(self, s: Tensor, following: Tensor) -> tuple[Tensor, Tensor]:
        """Return the regressors of R and of known signals at s, and those of R alone at s+."""
        mpc = self._mpc
        n_preview = (mpc.horizon + 1) * mpc.n_d
        signals = torch.cat((s[:, :n_preview], following[:, n_preview - mpc.n_d : n_preview]), 1)
        centre, spread = _units(s[:, n_preview:])
        y, y_next = ((p[:, n_preview:] - centre) / spread for p in (s, following))
        centre, spread = _units(signals)
        signals = (signals - centre) / spread
        before = torch.cat((y, y.square() - 1, signals), 1)
        return before, torch.cat((y_next, y_next.square() - 1, torch.zeros_like(signals)), 1)

    def state_dict(self) -> dict[str, Any]:
        """Return the remembered pairs."""
        return {"past": self._past}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a `state_dict`."""
        self._past = state["past"]


def _units(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean and the deviation of each column, the latter infinite for a constant."""
    centre, spread = x.mean(0), (x - x.mean(0)).square().mean(0).sqrt()
    return centre, torch.where(spread > FLOOR * (1 + centre.abs()), spread, torch.inf)


def _rms(x: Tensor) -> float:
    """Return the root mean square, 0 of nothing."""
    return float(x.square().mean().sqrt()) if len(x) else 0.0
