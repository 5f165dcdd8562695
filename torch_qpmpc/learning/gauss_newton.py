"""Second-order Q-learning: a Levenberg-Marquardt step on a batch of TD errors.

`torch_qpmpc.learning.kernel` has its program, the metric D on theta, and the dual that solves it.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torch_qpmpc.checks import POSITIVE, check_kind, check_number, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.learning.kernel import (
    FRESH,
    Block,
    Dense,
    OuterProducts,
    damping_of,
    objective,
    scale,
    signal_sizes,
    solve_dual,
)
from torch_qpmpc.learning.td_error import inverse_variance, usable
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.validation import without_gradients
from torch_qpmpc.qp.derivatives import envelope_gradients
from torch_qpmpc.qp.program import EVENT_SHAPES
from torch_qpmpc.qp.solution import QPSolution

#: A ratio of actual to predicted decrease below POOR raises the damping; one above GOOD lowers it.
POOR, GOOD = 0.25, 0.75
#: Factors by which the damping rises and falls, and its upper bound.
RISE, FALL, MAX_DAMPING = 4.0, 0.5, 1e6
#: Rejections in a row that are warned of, and the pairs that a step is tried on first where the
#: one before left QPs unsolved: these take long.
STALLED, FIRST = 5, 16


@dataclass(frozen=True)
class StepReport:
    """The outcome of a `GaussNewton.step`.

    Attributes:
        damping: mu as a fraction of the mean of K's diagonal, as used by the step.
        ratio: actual over predicted decrease of the objective; nan without a step.
        accepted: True if theta has moved.
        usable: True for pairs with a solution and a finite target, ``(B,)``.
        solution: the solution of Q(s, a) before the step.
    """

    damping: float
    ratio: float
    accepted: bool
    usable: Tensor = field(repr=False)
    solution: QPSolution


class GaussNewton(torch.optim.Optimizer):
    """A Levenberg-Marquardt optimiser of the learned parts of a `QPMPC`.

    It solves the batch again after each step and its projection, undoes one that raised the squared
    errors or left a QP unsolved, and adapts the damping to actual over predicted decrease. Five
    steps undone in a row are a `RuntimeWarning`.

    ``lr``, the fraction of each step that is taken, follows torch's schedulers. Of a part with a
    mask in the QPMPC's ``learn`` it moves the entries that are learned.

    Args:
        mpc: the QPMPC. With ``on_failure="mask"``, pairs without a solution are left out.
        scales: the factor in the metric D of each learned part of theta, or of all parts of the
            ``"cost"`` and of the ``"constraints"``, as in `QPMPC.parameter_groups`. They have no
            unit, and only their ratios matter; by default 1 and 3.
        lr: the initial fraction, in (0, 1].
        damping: mu as a fraction of the mean of K's diagonal, and the lower bound on it. A larger
            one makes a step less sensitive to its batch's noise.

    Raises:
        QPError: if a number is out of range, or the scales do not fit the learned parts.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> A, B = [[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]]
        >>> mpc = qm.QPMPC.from_model(A, B, 3, stage_weight=[1.0, 1.0, 0.1])
        >>> optimizer = qm.GaussNewton(mpc)
        >>> s, a = torch.ones(1, 2), torch.zeros(1, 1)
        >>> target = mpc.action_value(s, a).detach() + 1.0  # L + gamma V(s+)
        >>> optimizer.step(s, a, target).accepted
        True
        >>> bool((mpc.action_value(s, a) - target).abs() < 0.01)
        True
    """

    def __init__(
        self,
        mpc: QPMPC,
        *,
        scales: Mapping[str, float] | None = None,
        lr: float = 1.0,
        damping: float = 0.03,
    ) -> None:
        remedy = "Pass the QPMPC itself: its learned parts are the parameters."
        check_kind("mpc", mpc, QPMPC, remedy)
        check_number("lr", lr, lambda x: 0 < x <= 1, "a number in (0, 1]")
        check_number("damping", damping, *POSITIVE)
        groups = mpc.parameter_groups(scales or {"cost": 1.0, "constraints": 3.0})
        for group in groups:
            check_number(f"scales[{group['name']}]", group["lr"], *POSITIVE)
            group |= {"scale": group["lr"], "lr": lr, "damping": damping, **FRESH}
        super().__init__(groups, {})
        self._mpc, self._least_damping = mpc, damping

    @without_gradients
    def step(  # pyright: ignore[reportIncompatibleMethodOverride] - not a closure
        self,
        s: Tensor,
        a: Tensor,
        target: Tensor,
        *,
        weights: Tensor | None = None,
        clip: float | None = None,
        weighted: bool = False,
        penalty: Tensor | None = None,
        warm_start: Tensor | None = None,
    ) -> StepReport:
        """Move theta so that Q(s, a) approaches ``target``, within the limits of the damping.

        Args:
            s, a: visited pairs, ``(B, n_p)`` and ``(B, n_u)``.
            target: costs to go, L + gamma V(s+), ``(B,)``. Pairs with a target that is not finite
                are left out; if none is left, theta stays, with a `RuntimeWarning`. The sign
                is not checked: negate rewards and TorchRL's values.
            weights: of each pair's ``1/2 delta^2``, ``(B,)``, relative to their mean.
            clip: bound on the absolute TD errors delta.
            weighted: multiply the weights by `inverse_variance`.
            penalty: S ``(n_z + 1, n_z + 1)`` of a penalty ``1/2 tr([C, b] S [C, b]')`` added to the
                batch's mean of ``1/2 delta^2``, such as `SystemIdentificationPenalty.curvature`;
                for a free C without a mask only, which it moves, and not b.
            warm_start: active sets of Q(s, a) to start from, ``(B, n_g)``.

        Returns:
            The outcome of the step.

        Raises:
            QPError: if a shape does not fit, C is penalised but tied or masked, or the QPMPC has
                new parameters, as after `QPMPC.release`.
        """
        self._check_parameters()
        self._check_batch(s, a, target, penalty)
        weights = torch.ones_like(target) if weights is None else weights
        check_tensor("weights", weights, len(s), batched=False)
        if not (weights.isfinite() & (weights >= 0)).all():
            raise QPError.expected("weights", "NaN, inf or below 0", "finite weights >= 0")
        if clip is not None:
            check_number("clip", clip, *POSITIVE)
        damping = self.param_groups[0]["damping"]
        with torch.enable_grad():
            qp = self._mpc.quadratic_program()
        solution = self._mpc.solve(s, a, warm_start, qp)
        use = usable(solution.value, target)

        def report(ratio: float, accepted: bool) -> StepReport:
            return StepReport(damping, ratio, accepted, use, solution)

        count, root = int(use.sum()), torch.where(use, weights, 0).to(solution.value)
        if not root.any():
            return report(math.nan, False)
        root = (count * root / root.sum()).sqrt()
        delta = torch.where(use, target.to(solution.value) - solution.value, 0)
        if clip is not None:
            delta = delta.clamp(-clip, clip)
        if weighted:
            root = root * inverse_variance(s, a, solution.value, delta, use).sqrt()
        # The root of a weight scales its pair's row, both its error and its gradient.
        delta = root * delta
        # Theta's own parts: what dynamics add is constant in theta.
        solution = replace(solution, qp=qp)
        blocks = self._blocks(solution, root, None if penalty is None else count * penalty)
        scale(blocks, count)
        mu = damping_of(blocks, damping)
        alpha, change = solve_dual(blocks, delta, mu)
        steps = [block.step(alpha) for block in blocks]
        if not (objective(delta, blocks).isfinite() and all(x.isfinite().all() for x in steps)):
            self._adapt(math.nan)
            for group in self.param_groups:
                group |= FRESH
            return report(math.nan, False)
        old = [block.leaf.clone() for block in blocks]
        ratio = self._try(blocks, steps, delta, change, (s, a, root, solution))
        accepted = ratio > 0  # False for nan, which an infinite cost causes
        if not accepted:
            for block, value in zip(blocks, old, strict=True):
                block.leaf.copy_(value)
        self._adapt(ratio)
        self._count(accepted, ratio == -math.inf)
        return report(ratio, accepted)

    def _check_batch(self, s: Tensor, a: Tensor, target: Tensor, penalty: Tensor | None) -> None:
        """Raise `QPError` if an argument of `step` does not fit."""
        mpc = self._mpc
        check_tensor("s", s, "B", mpc.n_p, batched=False)
        check_tensor("a", a, len(s), mpc.n_u, batched=False)
        check_tensor("target", target, len(s), batched=False, remedy="Squeeze its last dimension.")
        if not len(s):
            raise QPError.expected("s", "an empty batch", "at least one pair")
        if penalty is not None:
            remedy = "Pass SystemIdentificationPenalty.curvature(windows)."
            size = mpc.n_z + 1
            check_tensor("penalty", penalty, size, size, batched=False, remedy=remedy)
            if self._free_C() is None:
                got = "a C that is tied, masked or frozen"
                remedy = "In train.py, constraint.si=null omits it."
                raise QPError.expected("penalty", got, "a free C, learned as a whole", remedy)

    def _try(
        self,
        blocks: list[Block],
        steps: list[Tensor],
        delta: Tensor,
        change: Tensor,
        batch: tuple[Tensor, Tensor, Tensor, QPSolution],
    ) -> float:
        """Move and project theta; return the ratio of actual to predicted decrease.

        ``change`` is the step's predicted one of the TD errors ``delta``; ``batch`` has s, a, the
        rows' factors, 0 if not usable, and the solution before the step.
        """
        s, a, root, solution = batch
        lr, before = self.param_groups[0]["lr"], objective(delta, blocks)
        for block, step in zip(blocks, steps, strict=True):
            block.leaf.add_(step, alpha=lr)
        proposed = lr * change
        projected = self._project(blocks, proposed)
        predicted = before - objective(delta - projected, blocks)
        if self.param_groups[0].get("unsolved"):
            after = self._mpc.solve(s[:FIRST], a[:FIRST], solution.active[:FIRST])
            if not (after.solved | (root[:FIRST] == 0)).all():
                return -math.inf
        after = self._mpc.solve(s, a, warm_start=solution.active)
        if not (after.solved | (root == 0)).all():
            return -math.inf
        actual = root * torch.where(root > 0, after.value - solution.value, 0)
        decrease = before - objective(delta - actual, blocks)
        # Without a predicted decrease, reject the step only if the projection raised the objective.
        lost = not torch.equal(projected, proposed) and not decrease >= 0
        return float(decrease / predicted) if predicted > 0 else float(not lost)

    def __reduce__(self) -> tuple:
        # The copy would hold a QPMPC of its own, apart from its owner's copy of it.
        remedy = "Make a GaussNewton for the copied QPMPC, and load the state_dict into it."
        raise QPError.expected("GaussNewton", "a copy or a pickle", "its state_dict", remedy)

    def _check_parameters(self) -> None:
        """Raise `QPError` if the QPMPC has other parameters than this optimiser."""
        own = {id(parameter) for parameter in self._mpc.parameters()}
        groups = self.param_groups
        replaced = [x["name"] for x in groups if not own.issuperset(map(id, x["params"]))]
        if replaced:
            got = f"a QPMPC with new parameters of {', '.join(replaced)}"
            remedy = "Make a new GaussNewton after release and load_state_dict(assign=True)."
            raise QPError.expected("mpc", got, "the parameters of this optimiser", remedy)

    def _project(self, blocks: list[Block], change: Tensor) -> Tensor:
        """Project theta; return Q's ``change`` ``(B,)`` plus the projection's at first order."""
        leaves = {id(leaf) for leaf in self._mpc._projected().values()}
        dense = [x for x in blocks if isinstance(x, Dense) and id(x.leaf) in leaves]
        proposed = [block.leaf.clone() for block in dense]
        self._mpc.project_()
        for block, leaf in zip(dense, proposed, strict=True):
            change = change + block.rows @ (block.leaf - leaf).flatten()
        return change

    def _adapt(self, ratio: float) -> None:
        """Adapt the damping to the ratio of actual to predicted decrease; nan raises it."""
        for group in self.param_groups:
            if not ratio >= POOR:
                group["damping"] = min(RISE * group["damping"], MAX_DAMPING)
            elif ratio > GOOD:
                group["damping"] = max(FALL * group["damping"], self._least_damping)

    def _count(self, accepted: bool, unsolved: bool) -> None:
        """Count rejections in a row, and warn of the fifth; ``unsolved`` if a QP was."""
        rejected = 0 if accepted else self.param_groups[0].get("rejected", 0) + 1
        for group in self.param_groups:
            group |= {"rejected": rejected, "unsolved": unsolved}
        if rejected == STALLED:
            got = f"{STALLED} steps in a row that were taken back, because "
            got += "they left QPs unsolved" if unsolved else "they raised the TD errors"
            remedy = (
                "Theta stays, and learning may stall: make hard rows soft, learn less of theta "
                "(constraint=fixed in train.py), keep C nearer to its model (constraint=deviation) "
                "or take a larger batch."
            )
            error = QPError.expected("GaussNewton", got, "steps that are accepted", remedy)
            warnings.warn(str(error), RuntimeWarning, stacklevel=5)

    def _free_C(self) -> Tensor | None:
        """Return the parameter of C if all of it is learned, free and not frozen."""
        C = self._mpc._parameters.get("C")
        return C if C is not None and C.requires_grad else None

    def _blocks(self, solution: QPSolution, root: Tensor, S: Tensor | None) -> list[Block]:
        """Return Q's gradients in each learned part that is not frozen, times ``root``."""
        mpc, z = self._mpc, solution.z
        chi = root.unsqueeze(-1) * solution.chi[..., : mpc.horizon * mpc.n_x]
        pairs = [(leaf, group) for group in self.param_groups for leaf in group["params"]]
        pairs = [(leaf, group) for leaf, group in pairs if leaf.requires_grad]
        factored = self._free_C()
        dense = [leaf for leaf, _ in pairs if leaf is not factored]
        gradients = iter(_gradients(solution, root, dense, without_C=factored is not None))
        rows, columns = signal_sizes(mpc, self.param_groups[0], z[root > 0])
        units = {}
        if mpc.structure == "free":
            entries = (rows.unsqueeze(-1) / columns).flatten()
            units = {"C": entries, "b": rows, "q": 1 / columns}
        return [
            OuterProducts(leaf, group, chi, z, rows, columns, S, mpc.b.detach())
            if leaf is factored
            else Dense(leaf, group, next(gradients).reshape(len(z), -1), units.get(group["name"]))
            for leaf, group in pairs
        ]


def _gradients(
    solution: QPSolution, root: Tensor, leaves: list[Tensor], without_C: bool
) -> Sequence[Tensor]:
    """Return Q's gradients ``(B, *leaf.shape)`` in each leaf, times ``root`` ``(B,)``."""
    if not leaves:
        return ()
    z, lam = solution.z, solution.lam
    # Only the gradient in a learned w needs the slacks.
    sigma = solution.sigma if solution.qp.w.requires_grad else torch.zeros_like(lam)
    duals = solution.chi, lam, solution.eta, solution.xi
    gradients = envelope_gradients(root, z, sigma, *duals)
    parts = {n: getattr(solution.qp, n) for n in EVENT_SHAPES if n != "C" or not without_C}
    parts = {n: x for n, x in parts.items() if x.requires_grad}
    # Expanded to one copy per pair, each part has one gradient per pair.
    in_parts = [gradients[n](x.expand(len(z), *x.shape)) for n, x in parts.items()]
    options = {"is_grads_batched": True, "materialize_grads": True}
    return torch.autograd.grad(list(parts.values()), leaves, in_parts, **options)
