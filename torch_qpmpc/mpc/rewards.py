"""The cost of a scheme from the rewards of a log."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.cost import Cost
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.log import NEXT, logs, valid_steps
from torch_qpmpc.mpc.stage_cost import EXACT, StageCost, fit_stage_cost
from torch_qpmpc.mpc.validation import ungraded

REMEDY = (
    "Pass stage_weight (in train.py task.stage_weight), the weight W of the cost "
    "1/2 [x; u]' W [x; u], such as [1.0, 1.0, 0.1] for two states and an action."
)
UNUSABLE = (
    "The rewards depend on the next observation, but a tied C and a Riccati weight need a cost of "
    "the present one: choose constraint=free and another task.terminal_weight."
)
#: The least R2 without a warning, and the gain in R2 that is worth a cost of y_{k+1}.
GOOD, GAIN = 0.9, 1e-3
#: Steps whose error is beyond this many standard deviations, of a median's robust estimate, are
#: left out by `fit_most`; and the least shares of steps that it keeps and of variance explained.
OUTSIDE, MOST, QUADRATIC, ROUNDS = 6 * 1.4826, 0.9, 0.99, 10


class RewardCost(NamedTuple):
    """Stage costs fitted to rewards: of (d_k, y_k, u_k) and, unless None, of (y_{k+1}, u_k).

    The second is used only if it is ``usable``. ``kept`` is the share of the log's steps that they
    are fitted to. ``print`` shows R2 of both.
    """

    now: StageCost
    after: StageCost | None = None
    usable: bool = True
    kept: float = 1.0

    @property
    def shifted(self) -> bool:
        """True if the cost of (y_{k+1}, u_k) explains more and is usable."""
        return self.usable and self._later

    @property
    def _later(self) -> bool:
        return self.after is not None and self.after.R2 > self.now.R2 + GAIN

    @property
    def best(self) -> StageCost:
        """The cost that is used."""
        return self.after if self.after is not None and self.shifted else self.now

    @property
    def variables(self) -> str:
        """The signals that the cost that is used is of."""
        most = "" if self.kept == 1 else " in most steps"
        return ("(y_(k+1), u_k)" if self.shifted else "(y_k, u_k)") + most

    def __str__(self) -> str:
        text = f"stage cost fitted to the rewards: R2 {self.now.R2:.3f}"
        if self.after is not None:
            text += f" on (y_k, u_k), {self.after.R2:.3f} on (y_(k+1), u_k); the cost is of "
            text += self.variables
        if self.kept < 1:
            text += f", {self.kept:.1%} of them"
        if self._later and not self.usable:
            text += f"\n{UNUSABLE}"
        return text if self.best.R2 >= GOOD else f"{text}\n{_poor(self.best.R2)}"


def fit_rewards(
    log: Any, layout: Layout, diagonal: bool = False, after: bool = False, usable: bool = True
) -> RewardCost:
    """Fit stage costs to the rewards of a log, as `fit_stage_cost`.

    Args:
        log: logged steps, as in `as_log`, with ``("next", "reward")``.
        layout: the sizes.
        diagonal: fit a diagonal W.
        after: fit one of (y_{k+1}, u_k), too, without cross terms of both; not with known signals.
        usable: use that one if it explains more.

    Raises:
        QPError: rewards are missing or not finite.

    Warns:
        UserWarning: R2 of the better one is below 0.9.
    """
    d, y, u, following, cost = _all_observed(log, layout)
    now, later = fit_stage_cost(torch.cat((d, y, u), -1), cost, layout.n_d, diagonal), None
    if after and not layout.n_d:
        v = torch.cat((following, u), -1)
        later = fit_stage_cost(v, cost, diagonal=diagonal, n_apart=layout.n_u)
    fitted = RewardCost(now, later, usable)
    if not fitted.best.R2 >= GOOD:
        warnings.warn(_poor(fitted.best.R2), UserWarning, stacklevel=2)
    return fitted


def fit_most(
    log: Any, layout: Layout, fitted: RewardCost, diagonal: bool = False
) -> RewardCost | None:
    """Refit the cost robustly, with outlying steps left out.

    Fits in turn find these steps: jumps of a set-point that the observation shows too late, say.

    Args:
        log, layout, diagonal: as in `fit_rewards`.
        fitted: its costs.

    Returns:
        The cost; None unless it explains 99 % of the variance in 90 % of the steps or more, and
        ``fitted`` less than that in all.
    """
    if not fitted.best.R2 < QUADRATIC:
        return None
    d, y, u, following, cost = _all_observed(log, layout)
    v, n_apart = (following, layout.n_u) if fitted.shifted else (torch.cat((d, y), -1), 0)
    v, best = torch.cat((v, u), -1), fitted.best
    for _ in range(ROUNDS):
        error = (cost - best(v)).abs()
        # Without noise the median is rounding, which is relative to the terms of each step.
        terms = StageCost(best.W.abs(), best.q.abs(), best.c.abs())(v.abs())
        kept = error <= torch.maximum(OUTSIDE * error.median(), EXACT * terms)
        share = kept.double().mean().item()
        if share < MOST:
            return None
        n_free = 0 if fitted.shifted else layout.n_d
        best, before = fit_stage_cost(v[kept], cost[kept], n_free, diagonal, n_apart), best
        if best.R2 - before.R2 <= GAIN * 1e-3:
            break
    if best.R2 < QUADRATIC:
        return None
    if fitted.shifted:
        return RewardCost(fitted.now, best, kept=share)
    return RewardCost(best, kept=share)


def scheme_cost(
    fitted: StageCost, layout: Layout, gamma: float, hessian: str, shifted: bool = False
) -> Cost:
    """Return the cost of a scheme from a stage's, which x_N has, too.

    If it is ``shifted``, the stage's cost is of (x_{k+1}, u_k): its part of x is stage k + 1's,
    divided by the discount, and x_0 has none.
    """
    n_d, n_x, n_u, N = layout.n_d, layout.n_x, layout.n_u, layout.horizon
    diagonal = hessian == "diagonal"
    W = fitted.W[n_d:, n_d:].diagonal() if diagonal else fitted.W
    terminal = W[:n_x] if diagonal else W[: n_d + n_x, : n_d + n_x]
    d, x, u = fitted.q.split((n_d, n_x, n_u))
    if shifted:
        terminal, x = terminal / gamma, x / gamma
        W = W.repeat(N, *[1] * W.ndim)
        of_x = (slice(None), *[slice(n_x)] * terminal.ndim)
        W[of_x] = terminal
        W[0][of_x[1:]] = 0
    past = fitted.q.new_zeros(layout.n_before - layout.n_preview)
    stages = layout.stages(x.expand(N + 1, -1), u)
    if shifted:
        stages[:n_x] = 0
    ahead = gamma ** torch.arange(N if shifted else N + 1, dtype=torch.float64)
    q = torch.cat((d.repeat(N + 1), past, stages))
    return Cost(W, terminal, hessian, q=q, c=fitted.c * ahead.sum())


def _all_observed(log: Any, layout: Layout) -> tuple[Tensor, ...]:
    """Return d, y, u, the next y and the costs of the steps of all logs."""
    each = (_observed(steps, layout) for steps in logs(log))
    return tuple(map(torch.cat, zip(*each, strict=True)))


def _observed(steps: Any, layout: Layout) -> tuple[Tensor, ...]:
    """Return d, y, u, the next y and the costs of the steps that are not padding."""
    reward = steps.get(("next", "reward"), None) if hasattr(steps, "batch_size") else None
    if reward is None:
        raise _unfitted("a log without rewards")
    kept = valid_steps(steps)
    reward = ungraded("reward", reward).detach().cpu().reshape(steps.shape)[kept].double()
    if not reward.isfinite().all():
        raise _unfitted("a log with rewards of NaN or inf")
    u = steps["action"]
    d = steps["preview"][..., : layout.n_d] if layout.n_d else u[..., :0]
    y, following = (steps[key][..., -layout.n_x :] for key in ("observation", NEXT))
    parts = (part.detach().cpu().double()[kept] for part in (d, y, u, following))
    return *parts, -reward


def _poor(R2: float) -> str:
    return (
        f"The fitted stage cost explains {R2:.1%} of the rewards' variance: the controller "
        "minimises another cost than the plant's. Pass the plant's own cost as stage_weight (a "
        "matrix with hessian='block'), in train.py task.stage_weight, or a log about the states "
        "where the controller is to work. A reward of what is not observed needs a window: past."
    )


def _unfitted(got: str) -> QPError:
    expected = "a weight, or finite rewards to fit a cost to"
    return QPError.expected("stage_weight", f"none, and {got}", expected, REMEDY)
