"""Actions that take levels, such as on and off: V, Q and the policy of a mixed-integer QP.

V(s) is the minimum over the plans on levels, which branch and bound finds
(`torch_qpmpc.qp.kernels.levels`). The best plan's QP, whose rows are held at their levels, is then
solved and certified as any other: its multipliers give the gradient of V, which exists wherever the
best plan is unique.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.kernels import levels as kernel
from torch_qpmpc.qp.pipeline.arrays import BatchSolution
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.solve import AtRest, report, solve_programs
from torch_qpmpc.qp.program import QuadraticProgram, Status
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solve import solve
from torch_qpmpc.qp.tracing import is_eager

#: An action is on a level within this fraction of the levels' distance.
ON_LEVEL = 1e-6
#: The curvature of a search where H has none, relative to the cost's slope and the levels.
CURVATURE = 1e-7
#: The statuses with a plan and without, of a search that ends and of one at its cap.
STATUSES = np.array([Status.SOLVED, Status.NODE_LIMIT, Status.INFEASIBLE, Status.NOT_CONVERGED])
#: What has no use without levels.
DEFAULTS = {"min_on": 1, "min_off": 1, "start_cost": 0.0, "integer_horizon": None}
#: The most levels of an action, whose places are bytes in C.
MOST = 100


@dataclass(frozen=True, eq=False)
class Levels:
    """The decisions of a scheme on m actions with levels, in S stages."""

    actions: np.ndarray  # the places of the actions in u, ``(m,)``
    rows: np.ndarray  # the row of G that each decision holds, ``(m, S)``
    #: The entry of z that is the decision, ``(m, S)``; None if rows hold sums of several.
    entries: np.ndarray | None
    values: np.ndarray  # ascending levels, ``(m, L)``; the highest one fills the row
    rules: np.ndarray  # the fewest steps off and on, ``(m, 2)``
    starts: np.ndarray  # the costs of going on, ``(m, S)``
    max_nodes: int  # the most nodes of a search

    @classmethod
    def of(cls, scheme: Any) -> Levels | None:
        """Return the levels of a scheme; None without any.

        Raises:
            QPError: levels do not fit the horizon, prices or blocks.
        """
        bounds, layout = scheme.bounds, scheme.layout
        if not any(bounds.action_levels or ()):
            for name, default in DEFAULTS.items():
                value = getattr(bounds, name)
                if value is not None and np.any(np.asarray(value, dtype=object) != default):
                    raise QPError.expected(name, repr(value), "action_levels or u_levels")
            return None
        if layout.blocks:
            want = "no blocks: a level is decided in each stage"
            raise QPError.expected("blocks", f"{layout.blocks}", want, "Pass an integer_horizon.")
        N = layout.horizon
        if (S := bounds.integer_horizon or N) > N:
            raise QPError.expected("integer_horizon", f"{S}", f"at most the horizon {N}")
        actions = np.flatnonzero([bool(x) for x in bounds.action_levels])
        given = [bounds.action_levels[a] for a in actions]
        most = max(map(len, given))
        values = np.array([[*own, *own[-1:] * (most - len(own))] for own in given])
        first, size = layout.n_x + actions, layout.n
        if (own := bounds.level_rows) is not None:
            first, size = N * layout.n + layout.n_x + np.take(own, actions), layout.n_mixed
        rows = first[:, None] + size * np.arange(S)
        entries = rows + (layout.n_p - layout.n_x) if own is None else None
        if not scheme.theta["w"][rows].isinf().all():
            remedy = "Leave action_slack out, or inf for these actions."
            want = "hard bounds of actions on levels"
            raise QPError.expected("action_slack", "a price", want, remedy)
        names = "min_off", "min_on", "start_cost"
        off, on, cost = (_numbers(x, getattr(bounds, x), layout.n_u)[actions] for x in names)
        rules = np.stack((off, on), -1).astype(np.int64)
        starts = cost[:, None] * scheme.gamma ** np.arange(S)
        return cls(actions, rows, entries, values, rules, starts, bounds.max_nodes)

    def solve(
        self, qp: QuadraticProgram, fixed: Tensor, n_kept: int, solver: str, on_failure: str
    ) -> QPSolution:
        """Return the best plan's solution, whose value contains the costs of starts.

        The past is unknown: the first stage counts as no switch. Arguments are those of
        `torch_qpmpc.qp.solve.solve`.

        Returns:
            The solution, with the number of nodes as ``iterations``. With the status ``NODE_LIMIT``
            its ``value_error`` contains the gap to the best plan that there may be.
        """
        if not is_eager(theta := (*qp.tensors(), fixed)):
            want = "one outside torch.compile, torch.func and losses without deactivate_vmap=True"
            raise QPError.expected("action_levels", "a traced call", want)
        with torch.no_grad():
            programs, batch = Programs.of(*(x.detach().cpu() for x in theta), n_kept=n_kept)
            found = self.search(programs)
        places, active, costs, ends, nodes, gaps = (
            torch.from_numpy(x).reshape((*batch, *x.shape[1:])).to(qp.q.device) for x in found
        )
        free = np.isin(self.rows, programs.prepared.reduced(programs.n_f).rows)  # not u_0 of Q
        at = places.where(torch.from_numpy(free).to(places.device), -1)
        values = torch.from_numpy(self.values).to(qp.lb).expand(*at.shape[:-1], -1)
        level, none = values.gather(-1, at.clamp(min=0)), places[..., 0, 0] < 0
        lb, ub = (side.expand(*batch, -1).clone() for side in (qp.lb, qp.ub))
        for side in (lb, ub):
            side[..., self.rows] = level.where(at >= 0, side[..., self.rows])
        lb[none] = torch.inf  # above ub, where there is no plan
        best = replace(qp, lb=lb, ub=ub, check_values=False)
        solution = solve(best, fixed, n_kept, solver, "mask", active)
        status = solution.status.where((solution.status != Status.SOLVED) & ~none, ends)
        capped = status == Status.NODE_LIMIT
        if on_failure != "mask":
            failed = status.masked_fill(capped, Status.SOLVED)
            if failed.any():
                report(failed.reshape(-1).numpy(force=True), batch, on_failure)
            if capped.any():
                why = Status.NODE_LIMIT.explanation
                text = f"{capped.sum()} of {len(programs)} plans may not be the best: {why}."
                warnings.warn(text, RuntimeWarning, stacklevel=4)
        z, value = solution.z.clone(), solution.value + costs.to(qp.q.dtype)
        if self.entries is not None:  # a level to the last bit
            z[..., self.entries] = level.to(z).where(at >= 0, z[..., self.entries])
        gap = gaps.to(qp.q.dtype).where(capped, 0.0) / value.detach().abs().clamp(min=1e-12)
        other = {"status": status, "value_error": solution.value_error + gap, "iterations": nodes}
        return replace(solution, qp=best, z=z, value=value, **other)

    def within(self, lb: np.ndarray, ub: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and the last level within bounds of rows ``(*batch, n_g)``.

        They are places ``(*batch, m, S)``, the last one below the first if there is none.
        """
        lower, upper = (side[..., self.rows, None] for side in (lb, ub))
        room = kernel.ON_LEVEL * np.abs(values := self.values[:, None])
        inside = (lower - room <= values) & (values <= upper + room)
        inside[..., 1:] &= np.diff(values) > 0
        last = inside.shape[-1] - 1 - inside[..., ::-1].argmax(-1)
        return np.where(inside.any(-1), inside.argmax(-1), inside.shape[-1]), last

    def search(
        self, programs: Programs, runs: np.ndarray | None = None, hint: np.ndarray | None = None
    ) -> tuple[np.ndarray, ...]:
        """Return places of the levels, active sets, costs of starts, statuses, nodes and gaps."""
        n_f, theta, own = programs.n_f, programs.theta, programs.scaled()
        prepared, group, qps = own.prepared, own.group, own.reduced_qps()
        of, least = prepared.reduced(n_f).rows, 0.0
        root, of_rows = np.ones((1, 1)), np.ones((1, theta.G.shape[1]))
        if (units := programs.prepared.units) is not None:
            root, of_rows = np.sqrt(units.cost), units.rows
        if prepared.sizes(n_f).shift.any() and (slope := np.abs(qps.g).max(initial=0.0)) > 0:
            # A power of two, as each is kept.
            size = (np.abs(self.values).max(-1)[:, None] / of_rows[0, self.rows]).max()
            least = 2.0 ** np.ceil(np.log2(CURVATURE * slope / size))
        K, unit, _, to_free, _ = prepared.dual(n_f, float(least))
        scale, unit = unit[group], unit * of_rows[:, of] / root  # the latter in all original units
        lb, ub = prepared.theta.lb[:, of], prepared.theta.ub[:, of]
        with np.errstate(invalid="ignore"):
            shift = np.nan_to_num(np.where(np.isfinite(lb), lb - qps.l, ub - qps.u))
        free = shift / scale - np.einsum("bij,bj->bi", to_free[group], qps.g)
        parts = free, lb / scale, ub / scale, qps.w * scale
        free, lower, upper, w = (root[group] * x for x in parts)
        place = np.full(theta.G.shape[1], -1)
        place[of] = np.arange(len(of))
        rows = place[self.rows]
        given = self.rows[rows < 0]  # those of u_0 in Q, whose level is known
        known = np.einsum("bri,bi->br", theta.G[programs.group][:, given, :n_f], programs.fixed)
        span = np.ptp(self.values, axis=-1)
        near = ON_LEVEL * np.where(span > 0, span, np.abs(self.values[:, 0]))[(rows < 0).any(-1)]
        lb, ub = (np.tile(x, (len(group) // len(x), 1)) for x in (theta.lb, theta.ub))
        lb[:, given], ub[:, given] = known - near, known + near
        first, last = self.within(lb, ub)
        unit = np.pad(unit, ((0, 0), (0, 1)), constant_values=1.0)[:, rows, None]  # of -1 one
        runs = np.zeros(first.shape[:2], np.int64) if runs is None else runs[None, self.actions]
        hint = np.full(first.shape, -1) if hint is None else hint[None]
        places, lam, costs, capped, nodes, gaps = kernel.search(
            K, group, free, lower, upper, w, rows, self.values[:, None] / unit, self.rules,
            self.starts, runs, first, last, hint, self.max_nodes,
        )  # fmt: skip
        active = np.zeros((len(group), theta.G.shape[1]), np.int8)
        saturated = np.abs(lam) >= (1 - kernel.GAIN) * w
        active[:, of] = np.where(saturated, 2 * np.sign(lam), np.sign(lam))
        held = self.rows[rows >= 0]
        active[:, held] = np.where(active[:, held] == 0, 1, active[:, held])
        statuses = STATUSES[2 * (places[:, 0, 0] < 0) + capped]
        return places, active, costs, statuses, nodes, gaps

    def plan(
        self, at_rest: AtRest, fixed: np.ndarray, runs: np.ndarray, hint: np.ndarray | None
    ) -> tuple[BatchSolution, np.ndarray]:
        """Return the best plan's solution with a theta at rest, and the places of its levels.

        Multipliers of decisions are zero.

        Args:
            at_rest: the solver of the QPs.
            fixed: the first entries of z, ``(1, n_f)``.
            runs: for how many steps each action was on, or with a minus off, ``(n_u,)``; 0 is
                unknown.
            hint: places of levels ``(m, S)`` that may be good, such as the last plan's.
        """
        programs, prepared = at_rest.programs(fixed), at_rest.prepared
        places, active, _, (status,), *_ = self.search(programs, runs, hint)
        if (places < 0).any():
            return programs.unsolved(status), places[0]
        lb, ub = prepared.theta.lb.copy(), prepared.theta.ub.copy()
        lb[:, self.rows] = ub[:, self.rows] = np.take_along_axis(self.values, places[0], 1)
        programs = Programs(prepared.bounded(lb, ub), programs.group, fixed)
        solution = solve_programs(programs, at_rest.solver, active)
        solution.lam[0, self.rows] = 0.0
        solution.status[0] = solution.status[0] or status
        return solution, places[0]


def read_levels(value: Any, name: str = "action_levels") -> tuple[tuple[float, ...], ...]:
    """Read the levels of each action, none for an action between its bounds.

    Raises:
        QPError: they are not ascending.
    """
    try:
        levels = tuple(() if x is None else tuple(map(float, x)) for x in value)
    except (TypeError, ValueError):
        levels = ((np.nan,),)
    for own in levels:
        if not (len(own) <= MOST and np.isfinite(own).all() and (np.diff(own) > 0).all()):
            want = f"for each action up to {MOST} ascending numbers, or None"
            raise QPError.expected(name, repr(value), want, "The lowest level is off.")
    return levels


def _numbers(name: str, value: Any, n_u: int) -> np.ndarray:
    """Return a finite number >= 0 for each action, of minimum times a whole one >= 1."""
    of_time = np.bool_(name != "start_cost")
    try:
        numbers = np.broadcast_to(np.asarray(value, float), n_u)
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not (np.isfinite(numbers) & (numbers >= of_time) & (~of_time | (numbers % 1 == 0))).all():
        want = "a whole number >= 1" if of_time else "a number >= 0"
        raise QPError.expected(name, repr(value), f"{want}, or {n_u} of them")
    return numbers


def hull(
    name: str, bounds: Any, levels: Sequence[Any], names: Sequence[str], moves: Any = None
) -> tuple[Any, Any]:
    """Return bounds of inputs, arrays or tensors, at their lowest and highest levels within them.

    Raises:
        QPError: none of an input's levels is within its bounds, or bounds of its ``moves`` keep it
            from the next one.
    """
    lower, upper = (side + 0.0 for side in bounds)
    for i, own in enumerate(levels):
        kept = [x for x in own or () if lower[i] <= x <= upper[i]]
        if own and not kept:
            got = f"[{lower[i]:g}, {upper[i]:g}] of {names[i]}"
            want = f"bounds with one of its levels {', '.join(f'{x:g}' for x in own)}"
            raise QPError.expected(name, got, want)
        gap = np.diff(kept).max(initial=0.0)
        if moves is not None and not moves[0][i] <= -gap <= gap <= moves[1][i]:
            got = f"[{moves[0][i]:g}, {moves[1][i]:g}] of {names[i]}"
            raise QPError.expected("du_bounds", got, f"moves of {gap:g}, to its next level")
        if kept:
            lower[i], upper[i] = kept[0], kept[-1]
    return lower, upper
