"""Second-order Q-learning: a Levenberg-Marquardt step on a batch of TD errors, in kernel form.

With g_i = dQ(s_i, a_i)/dtheta by the envelope theorem and a metric D on theta, the step solves

    min over dtheta:  1/2 sum_i (delta_i - g_i'dtheta)^2 + 1/2 mu dtheta'D^-1 dtheta

by its dual, ``dtheta = D sum_i alpha_i g_i``, ``(K + mu I) alpha = delta``, ``K_ij = g_i'D g_j``:
a system as large as the batch. For a free C, whose gradients are the outer products chi_i z_i',
``K = (chi chi') * (z P z')``, and none of them is formed. P is the metric of C's rows: a multiple
of the identity, or with the SI penalty (eq:sdp3), a quadratic in each row, the inverse of the two
curvatures' sum, so that the penalty is part of the same step.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn

from torch_qpmpc.checks import check_flag, check_kind, check_number, check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.parameters import matrix
from torch_qpmpc.qp.derivatives import envelope_gradients
from torch_qpmpc.qp.program import EVENT_SHAPES
from torch_qpmpc.qp.solution import QPSolution

#: Decrease over predicted decrease: below the first the damping rises, above the second it falls.
POOR, GOOD = 0.25, 0.75
RISE, FALL, MOST_DAMPING = 4.0, 0.5, 1e6


def _positive(x: float) -> bool:
    return 0 < x < math.inf


@dataclass(frozen=True, repr=False)
class StepReport:
    """What a step did.

    Attributes:
        solution: of Q(s, a) before the step.
        damping: mu as a fraction of the mean of K's diagonal, as it was used.
        ratio: the decrease of the squared errors over the predicted one; nan without trust region.
        accepted: True if theta has moved.
        unsolved: pairs that were left out because their QP has no solution.
        without_target: other pairs that were left out because their target is not finite.
    """

    solution: QPSolution
    damping: float
    ratio: float
    accepted: bool
    unsolved: int = 0
    without_target: int = 0

    def __repr__(self) -> str:
        """Each field in one line, the solution in its own few."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        numbers = (f"{name}={x!r}" for name, x in values.items() if name != "solution")
        return f"StepReport({', '.join(numbers)}, solution={self.solution!r})"


class GaussNewton(torch.optim.Optimizer):
    """Levenberg-Marquardt steps for the learned parts of a `QPMPC`, whichever they are.

    Its ``lr``, which torch's schedulers change, is the part of the step that is taken.

    Args:
        mpc: the QPMPC. With ``on_failure="mask"``, pairs without a solution are left out.
        scales: the metric D, a factor for each learned part of theta or for the ``"cost"`` and the
            ``"constraints"``, as in `QPMPC.parameter_groups`. Only their ratios matter.
        lr: the part of the step at first, in (0, 1].
        damping: mu, as a fraction of the mean of K's diagonal; the least that the trust region
            comes back to. It also says how far the noise of one batch is to be believed.
        td_error_clip: bound of the TD error; none by default.
        memory: how many gradients of past pairs a step respects: it changes their Q as little as
            their part of the sum says, though nothing of them is solved again. For small batches,
            down to a stream of single transitions; the recursive form of least squares.
        trust_region: solve the batch again after a step and its projection (`QPMPC.project_`); take
            back one that raised the squared errors (the targets held), and adapt the damping to how
            well they were predicted.

    Raises:
        QPError: a number out of its range, or scales that do not fit the learned parts.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC(2, 1, 3, solver="daqp")
        >>> optimizer = qm.GaussNewton(mpc)
        >>> s, a = torch.ones(1, 2), torch.zeros(1, 1)
        >>> target = mpc.action_value(s, a).detach() + 1.0  # L + gamma V(s+)
        >>> optimizer.step(s, a, target).accepted
        True
        >>> bool((mpc.action_value(s, a) - target).abs() < 0.2)
        True
    """

    def __init__(
        self,
        mpc: QPMPC,
        *,
        scales: Mapping[str, float] | None = None,
        lr: float = 1.0,
        damping: float = 0.03,
        td_error_clip: float | None = None,
        memory: int = 0,
        trust_region: bool = True,
    ) -> None:
        remedy = "Pass the QPMPC itself: its learned parts are the parameters."
        check_kind("mpc", mpc, QPMPC, remedy)
        check_whole("memory", memory, 0)
        check_number("lr", lr, lambda x: 0 < x <= 1, "a number in (0, 1]")
        check_number("damping", damping, _positive, "a finite number > 0")
        if td_error_clip is not None:
            check_number("td_error_clip", td_error_clip, _positive, "a finite number > 0")
        check_flag("trust_region", trust_region)
        groups = mpc.parameter_groups(scales or {"cost": 1.0, "constraints": 1e-2})
        for group in groups:
            check_number(f"scales[{group['name']}]", group["lr"], _positive, "a finite number > 0")
            group |= {"scale": group["lr"], "lr": lr, "damping": damping}
        super().__init__(groups, {})
        self._mpc, self._least_damping = mpc, damping
        self._clip, self._memory, self._trust_region = td_error_clip, memory, trust_region

    @torch.no_grad()
    def step(  # pyright: ignore[reportIncompatibleMethodOverride] - not a closure
        self,
        s: Tensor,
        a: Tensor,
        target: Tensor,
        *,
        penalty: Tensor | None = None,
        warm_start: Tensor | None = None,
    ) -> StepReport:
        """Move theta so that Q(s, a) approaches ``target``, as far as the damping lets it.

        Args:
            s, a: visited pairs, ``(B, n_x)`` and ``(B, n_u)``.
            target: costs to go, L + gamma V(s+), ``(B,)``; where it is not finite, the pair is
                left out and counted. If no pair is left, nothing moves, with a `RuntimeWarning`.
                That a target has the wrong sign, as a reward or TorchRL's values have, cannot be
                told from its numbers.
            penalty: S ``(n_z, n_z)`` of a penalty ``1/2 tr(C S C')`` against the batch's mean of
                ``1/2 delta^2``, such as `SystemIdentificationPenalty.curvature`; for a free C.
            warm_start: active sets of Q(s, a), ``(B, n_g)``.

        Raises:
            QPError: a shape that does not fit, a penalty without a free C, or a QPMPC that got
                other parameters, as by `QPMPC.release`.
        """
        mpc = self._mpc
        self._check_parameters()
        check_tensor("s", s, "B", mpc.n_x, batched=False)
        check_tensor("a", a, len(s), mpc.n_u, batched=False)
        check_tensor("target", target, len(s), batched=False, remedy="Squeeze its last dimension.")
        if not len(s):
            raise QPError.expected("s", "an empty batch", "at least one pair")
        if penalty is not None:
            remedy = "Pass SystemIdentificationPenalty.curvature(windows)."
            check_tensor("penalty", penalty, mpc.n_z, mpc.n_z, batched=False, remedy=remedy)
        group = self.param_groups[0]
        with torch.enable_grad():
            qp = self._mpc.quadratic_program()
        solution = self._mpc.solve(s, a, warm_start, qp)
        use = solution.solved & target.isfinite()
        unsolved = int((~solution.solved).sum())
        left_out = unsolved, len(s) - unsolved - int(use.sum())
        if sum(left_out) == len(s):
            message = (
                f"None of the {len(s)} pairs can be learned from: {left_out[0]} have a QP without "
                f"a solution, {left_out[1]} a target that is not finite. Theta stays."
            )
            warnings.warn(message, RuntimeWarning, stacklevel=2)
            return StepReport(solution, group["damping"], math.nan, False, *left_out)
        delta = torch.where(use, target.to(solution.value) - solution.value, 0)
        if self._clip is not None:
            delta = delta.clamp(-self._clip, self._clip)
        if penalty is not None:
            penalty = (len(s) - sum(left_out)) * penalty
        lr, damping = group["lr"], group["damping"]
        blocks = self._blocks(solution, use, penalty)
        for block in blocks:
            block.remember(self.state[block.leaf], self._memory)
        # The past has no errors: only its curvature is known.
        past = delta.new_zeros(len(blocks[0]) - len(delta) if blocks else 0)
        alpha, change = _solve(blocks, torch.cat((delta, past)), damping)
        change = change[: len(delta)]
        steps = [block.step(alpha) for block in blocks]
        before = _objective(delta, blocks)
        if not before.isfinite() or not all(step.isfinite().all() for step in steps):
            # Numbers too large to be squared: more damping, and nothing of them in the memory.
            self._adapt(math.nan)
            self.state.clear()
            return StepReport(solution, damping, math.nan, False, *left_out)
        if not self._trust_region:
            _move(blocks, steps, lr)
            self._mpc.project_()
            return StepReport(solution, damping, math.nan, True, *left_out)
        old = [block.leaf.clone() for block in blocks]
        _move(blocks, steps, lr)
        proposed = lr * change
        change = self._project(blocks, proposed)
        predicted = before - _objective(delta - change, blocks)
        again = self._mpc.solve(s, a, warm_start=solution.active)
        decrease = before - _objective(
            delta - torch.where(use, again.value - solution.value, 0), blocks
        )
        # With nothing to gain there is nothing to judge, but a projection can make it a loss.
        lost = not torch.equal(change, proposed) and not decrease >= 0
        ratio = float(decrease / predicted) if predicted > 0 else float(not lost)
        accepted = ratio > 0  # false for the NaN of an infinite cost
        if not accepted:
            for block, value in zip(blocks, old, strict=True):
                block.leaf.copy_(value)
        self._adapt(ratio)
        return StepReport(solution, damping, ratio, accepted, *left_out)

    def __reduce__(self) -> tuple:
        # The module would be another one than that which its owner copies or saves beside it.
        raise QPError.expected(
            "GaussNewton",
            "a copy or a pickle",
            "its state_dict",
            "Make another one for the copied QPMPC, and load the state_dict into it.",
        )

    def _check_parameters(self) -> None:
        """Raise `QPError` if the QPMPC's parameters are no longer those of this optimiser."""
        own = {id(parameter) for parameter in self._mpc.parameters()}
        groups = self.param_groups
        lost = [x["name"] for x in groups if not own.issuperset(map(id, x["params"]))]
        if lost:
            got = f"a QPMPC that has other parameters of {', '.join(lost)} by now"
            remedy = (
                "QPMPC.release, and load_state_dict with assign=True, give it new ones: make the "
                "GaussNewton anew after it."
            )
            raise QPError.expected("mpc", got, "the parameters of this optimiser", remedy)

    def _project(self, blocks: list[_Dense | _OuterProducts], change: Tensor) -> Tensor:
        """Project theta; ``change`` of Q with what that adds to it at first order, ``(B,)``."""
        leaves = {id(leaf) for leaf in self._mpc._projected().values()}
        dense = [x for x in blocks if isinstance(x, _Dense) and id(x.leaf) in leaves]
        proposed = [block.leaf.clone() for block in dense]
        self._mpc.project_()
        for block, leaf in zip(dense, proposed, strict=True):
            change = change + block.rows[: len(change)] @ (block.leaf - leaf).flatten()
        return change

    def _adapt(self, ratio: float) -> None:
        for group in self.param_groups:
            if not ratio >= POOR:
                group["damping"] = min(RISE * group["damping"], MOST_DAMPING)
            elif ratio > GOOD:
                group["damping"] = max(FALL * group["damping"], self._least_damping)

    def _blocks(
        self, solution: QPSolution, use: Tensor, penalty: Tensor | None
    ) -> list[_Dense | _OuterProducts]:
        """The gradients of Q in each learned part that is not frozen, zero where not in ``use``."""
        mpc = self._mpc
        weight = use.to(solution.z)
        z, chi, lam = solution.z, solution.chi, solution.lam
        # The slacks are only asked for by a w that is learned.
        sigma = solution.sigma if solution.qp.w.requires_grad else torch.zeros_like(lam)
        gradients = envelope_gradients(weight, z, sigma, chi, lam, solution.xi)
        pairs = [(leaf, group["scale"]) for group in self.param_groups for leaf in group["params"]]
        pairs = [(leaf, scale) for leaf, scale in pairs if leaf.requires_grad]
        C, mask = matrix(mpc, "C")
        factored = next((leaf for leaf, _ in pairs if leaf is C), None)
        if factored is not None and mask is not None:
            factored.copy_(mpc.C)  # another optimiser may have moved entries that are not learned
        if penalty is not None and factored is None:
            raise QPError.expected("penalty", "a C that is not free", "C among the learned parts")
        parts = {name: getattr(solution.qp, name) for name in EVENT_SHAPES}
        if factored is not None:
            parts.pop("C")
        parts = {n: x for n, x in parts.items() if x.requires_grad}
        # Of a tensor for each pair, the gradient is that of each pair.
        of_each = [gradients[n](x.expand(len(z), *x.shape)) for n, x in parts.items()]
        dense = [leaf for leaf, _ in pairs if leaf is not factored]
        found = iter(())
        if dense:
            found = iter(
                torch.autograd.grad(
                    list(parts.values()),
                    dense,
                    of_each,
                    is_grads_batched=True,
                    materialize_grads=True,
                )
            )
        return [
            _OuterProducts(leaf, scale, weight.unsqueeze(-1) * chi, z, penalty, mask)
            if leaf is factored
            else _Dense(leaf, scale, next(found).reshape(len(z), -1))
            for leaf, scale in pairs
        ]


def _past(state: dict[str, Tensor], name: str, today: Tensor) -> Tensor:
    """The remembered rows of the kind of ``today`` ``(B, n)``; none at first."""
    past = state.get(name, today[:0])
    if past.shape[1:] != today.shape[1:]:
        got = f"a memory of gradients of {past.shape[1]} entries"
        want = f"{today.shape[1]}, as this QPMPC has"
        remedy = "Load the state of a GaussNewton of the same QPMPC."
        raise QPError.expected("state_dict", got, want, remedy)
    return past


class _Dense:
    """The gradients in one parameter, as rows ``(B, n)``; its metric is ``scale``."""

    def __init__(self, leaf: nn.Parameter, scale: float, rows: Tensor) -> None:
        self.leaf, self.scale, self.rows = leaf, scale, rows

    def __len__(self) -> int:
        return len(self.rows)

    def remember(self, state: dict[str, Tensor], count: int) -> None:
        """Append up to ``count`` gradients of the past, and keep the newest for the next step."""
        if count:
            self.rows = torch.cat((self.rows, _past(state, "rows", self.rows)))
            state["rows"] = self.rows[:count]

    def diagonal(self) -> Tensor:
        """Of the kernel, ``(B,)``."""
        return self.scale * self.rows.square().sum(-1)

    def damp(self, mu: Tensor) -> Tensor:
        """What the parameter's own penalty makes of Q, ``(B,)``: it has none."""
        return self.rows.new_zeros(len(self.rows))

    def kernel(self) -> Tensor:
        return self.scale * self.rows @ self.rows.mT

    def step(self, alpha: Tensor) -> Tensor:
        return (self.scale * alpha @ self.rows).reshape(self.leaf.shape)

    def penalty(self) -> Tensor | float:
        return 0.0


class _OuterProducts:
    """The gradients ``chi_i z_i'`` in C, with the metric P ``(n_z, n_z)`` of its rows.

    The penalty ``1/2 tr(C S C')`` draws C by ``drift`` before any TD error does. Where a ``mask``
    says which entries of C are learned, rows of the same pattern have a P of their own.
    """

    def __init__(
        self,
        leaf: nn.Parameter,
        scale: float,
        chi: Tensor,
        z: Tensor,
        S: Tensor | None,
        mask: Tensor | None = None,
    ) -> None:
        self.leaf, self.scale, self.chi, self.z, self.S = leaf, scale, chi, z, S
        self.drift = torch.zeros_like(leaf)
        self.patterns = _patterns(mask)

    def __len__(self) -> int:
        return len(self.z)

    def remember(self, state: dict[str, Tensor], count: int) -> None:
        if count:
            self.chi = torch.cat((self.chi, _past(state, "chi", self.chi)))
            self.z = torch.cat((self.z, _past(state, "z", self.z)))
            state["chi"], state["z"] = self.chi[:count], self.z[:count]

    def diagonal(self) -> Tensor:
        chi, z = self.chi.square(), self.z.square()
        found = (chi[:, i].sum(-1) * z[:, j].sum(-1) for i, j, _ in self.patterns)
        return self.scale * sum(found, torch.zeros_like(z[:, 0]))

    def damp(self, mu: Tensor) -> Tensor:
        drifted = self.z.new_zeros(len(self.z))
        self.z_P = [self.scale * self.z[:, j] for _, j, _ in self.patterns]
        if self.S is None:
            return drifted
        force = self.leaf @ self.S
        for k, (i, j, entries) in enumerate(self.patterns):
            z, S = self.z[:, j], self.S[j][:, j]
            precision = mu / self.scale * torch.eye(len(S)).to(S) + S
            inverse = torch.linalg.inv_ex(precision).inverse
            drift = -force[entries] @ inverse
            self.z_P[k], self.drift[entries] = mu * z @ inverse, drift
            drifted = drifted + ((self.chi[:, i] @ drift) * z).sum(-1)
        return drifted

    def kernel(self) -> Tensor:
        K = self.z.new_zeros(len(self.z), len(self.z))
        for (i, j, _), z_P in zip(self.patterns, self.z_P, strict=True):
            chi = self.chi[:, i]
            K = K + (chi @ chi.mT) * (z_P @ self.z[:, j].mT)
        return K

    def step(self, alpha: Tensor) -> Tensor:
        found = self.drift.clone()
        for (i, _, entries), z_P in zip(self.patterns, self.z_P, strict=True):
            found[entries] += (alpha.unsqueeze(-1) * self.chi[:, i]).mT @ z_P
        return found

    def penalty(self) -> Tensor | float:
        return 0.0 if self.S is None else 0.5 * ((self.leaf @ self.S) * self.leaf).sum()


def _patterns(mask: Tensor | None) -> list[tuple[Any, Any, Any]]:
    """The rows of C that learn the same entries, which these are, and the index of both in C."""
    if mask is None:
        return [(slice(None), slice(None), (slice(None), slice(None)))]
    kinds, kind = torch.unique(mask, dim=0, return_inverse=True)
    pairs = [((kind == k).nonzero()[:, 0], x.nonzero()[:, 0]) for k, x in enumerate(kinds)]
    return [(i, j, (i.unsqueeze(-1), j)) for i, j in pairs if len(j)]


def _solve(
    blocks: list[_Dense | _OuterProducts], delta: Tensor, damping: float
) -> tuple[Tensor, Tensor]:
    """alpha ``(B,)``, and the change of Q that the whole step is expected to make, ``(B,)``."""
    mu = damping * sum((block.diagonal() for block in blocks), torch.zeros_like(delta)).mean()
    mu = mu.clamp(min=torch.finfo(mu.dtype).tiny)
    drifted = sum((block.damp(mu) for block in blocks), torch.zeros_like(delta))
    K = sum((block.kernel() for block in blocks), delta.new_zeros(len(delta), len(delta)))
    damped = K + mu * torch.eye(len(delta)).to(delta)
    factor, failed = torch.linalg.cholesky_ex(damped)
    alpha = torch.cholesky_solve((delta - drifted).unsqueeze(-1), factor).squeeze(-1)
    alpha = torch.where(failed == 0, alpha, math.nan)
    return alpha, K @ alpha + drifted


def _move(blocks: list[_Dense | _OuterProducts], steps: list[Tensor], lr: float) -> None:
    for block, step in zip(blocks, steps, strict=True):
        block.leaf.add_(step, alpha=lr)


def _objective(left: Tensor, blocks: list[_Dense | _OuterProducts]) -> Tensor:
    """What a step is to decrease: half the squared errors, and the penalties."""
    return 0.5 * left.square().sum() + sum(block.penalty() for block in blocks)
