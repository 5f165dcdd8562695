"""Actions that take levels, such as on and off: V, Q and the policy of a mixed-integer QP.

V(s) is the minimum over the plans on levels, which branch and bound finds
(`torch_qpmpc.qp.kernels.levels`). The best plan's QP, whose rows are held at their levels, is then
solved and certified as any other: its multipliers give the gradient of V, which exists wherever the
best plan is unique.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from torch_qpmpc.checks import check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.kernels import levels as kernel
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, to_numpy
from torch_qpmpc.qp.pipeline.batch import Prepared, Programs, prepared_for
from torch_qpmpc.qp.pipeline.solve import report, solve_programs
from torch_qpmpc.qp.program import UNKNOWN, QuadraticProgram, Status
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solve import solve
from torch_qpmpc.qp.tracing import is_eager

#: An action is on a level within this fraction of the levels' distance.
ON_LEVEL = 1e-6
#: The curvature of a search where H has none, relative to the cost's slope and the levels.
CURVATURE = 1e-7
#: The statuses of the search's outcomes.
STATUSES = np.array([Status.SOLVED, Status.NODE_LIMIT, Status.INFEASIBLE, Status.NOT_CONVERGED])
#: What has no use without levels.
DEFAULTS = {"min_on": 1, "min_off": 1, "start_cost": 0.0, "integer_horizon": None}
#: The most levels of an action, which are the bits of a mask.
MOST = 60


@dataclass(frozen=True, eq=False)
class Levels:
    """The decisions of a scheme on m actions with levels, in S stages.

    Attributes:
        actions: the places of the actions in u, ``(m,)``.
        rows: the row of G that each decision holds, ``(m, S)``.
        values: ascending levels, ``(m, L)``, of which the first ``counts`` ``(m,)`` are used.
        rules: the fewest steps off and on, ``(m, 2)``.
        starts: the costs of going on, ``(m, S)``.
        max_nodes: the most nodes of a search.
    """

    actions: np.ndarray
    rows: np.ndarray
    values: np.ndarray
    counts: np.ndarray
    rules: np.ndarray
    starts: np.ndarray
    max_nodes: int

    @classmethod
    def of(cls, scheme: Any) -> Levels | None:
        """Return the levels of a scheme; None without any.

        Raises:
            QPError: levels do not fit the sizes, bounds, prices or blocks.
        """
        bounds, layout = scheme.bounds, scheme.layout
        if bounds.action_levels is None or not any(bounds.action_levels):
            check_used("action_levels", {name: getattr(bounds, name) for name in DEFAULTS})
            return None
        n_u, N = layout.n_u, layout.horizon
        if len(bounds.action_levels) != n_u:
            got = f"{len(bounds.action_levels)} entries"
            raise QPError.expected("action_levels", got, f"{n_u}, one for each action, or None")
        if layout.blocks:
            want = "no blocks: a level is decided in each stage"
            raise QPError.expected("blocks", f"{layout.blocks}", want, "Pass an integer_horizon.")
        S = N if bounds.integer_horizon is None else bounds.integer_horizon
        if S > N:
            raise QPError.expected("integer_horizon", f"{S}", f"at most the horizon {N}")
        actions = np.flatnonzero([bool(x) for x in bounds.action_levels])
        given = [bounds.action_levels[a] for a in actions]
        values = np.zeros((len(given), max(map(len, given))))
        for own, levels in zip(values, given, strict=True):
            own[: len(levels)] = levels
        own_rows, first = bounds.level_rows or [-1] * n_u, N * layout.n + layout.n_x
        rows = np.array(
            [
                [k * layout.n + layout.n_x + a, first + k * layout.n_mixed + own_rows[a]][
                    own_rows[a] >= 0
                ]
                for a in actions
                for k in range(S)
            ]
        ).reshape(len(actions), S)
        if not scheme.theta["w"][rows].isinf().all():
            remedy = "Leave action_slack out, or inf for these actions."
            raise QPError.expected(
                "action_slack", "a price", "hard bounds of actions on levels", remedy
            )
        numbers = {
            "min_off": bounds.min_off,
            "min_on": bounds.min_on,
            "start_cost": bounds.start_cost,
        }
        off, on, cost = (_numbers(name, x, n_u)[actions] for name, x in numbers.items())
        for name, steps in (("min_off", off), ("min_on", on)):
            for x in steps:
                check_whole(name, float(x) if x % 1 else int(x), 1)
        rules = np.stack((off, on), -1).astype(np.int64)
        starts = cost[:, None] * scheme.gamma ** np.arange(S)
        counts = np.array([len(x) for x in given])
        return cls(actions, rows, values, counts, rules, starts, bounds.max_nodes)

    @property
    def identity(self) -> list[Any]:
        """What values depend on, as lists."""
        parts = self.values, self.counts, self.rows, self.rules, self.starts
        return [x.tolist() for x in parts] + [self.max_nodes]

    def solve(
        self,
        qp: QuadraticProgram,
        fixed: Tensor,
        n_kept: int,
        solver: str,
        on_failure: str,
        runs: np.ndarray | None = None,
        hint: np.ndarray | None = None,
    ) -> QPSolution:
        """Return the best plan's solution, whose value contains the costs of starts.

        Args:
            qp, fixed, n_kept, solver, on_failure: as in `torch_qpmpc.qp.solve.solve`.
            runs: for how many steps each action was on, or with a minus off, ``(*batch, m)``; by
                default 0, unknown: then the first stage counts as no switch.
            hint: places of levels ``(*batch, m, S)`` that may be good, such as the last plan's.

        Returns:
            The solution, with the number of nodes as ``iterations``. With the status ``NODE_LIMIT``
            its ``value_error`` contains the gap to the best plan that there may be.
        """
        theta = (*qp.tensors(), fixed)
        if not is_eager(theta):
            want = "a call outside torch.compile and torch.func, as a search depends on values"
            raise QPError.expected("action_levels", "a traced call", want)
        with torch.no_grad():
            programs, batch = Programs.of(*(x.detach().cpu() for x in theta), n_kept=n_kept)
            m, S = self.rows.shape
            B = len(programs)
            runs = np.zeros((B, m), np.int64) if runs is None else runs.reshape(B, m)
            hint = np.full((B, m, S), -1) if hint is None else hint.reshape(B, m, S)
            places, active, costs, outcomes, nodes, gaps = self.search(programs, runs, hint)
        found, n_g = places[:, 0, 0] >= 0, qp.lb.shape[-1]
        values = np.take_along_axis(self.values[None].repeat(B, 0), places.clip(0), -1)
        held = torch.zeros(B, n_g, dtype=torch.bool)
        level = torch.zeros(B, n_g, dtype=torch.float64)
        reduced = programs.prepared.reduced(programs.n_f).rows
        free = torch.from_numpy(np.isin(self.rows.ravel(), reduced))  # not u_0 of Q
        level[:, self.rows.ravel()] = torch.from_numpy(values.reshape(B, -1))
        held[:, self.rows.ravel()] = torch.from_numpy(found)[:, None] & free
        held, level = (x.reshape(*batch, n_g).to(qp.lb.device) for x in (held, level))
        level = level.to(qp.lb.dtype)
        lb, ub = torch.where(held, level, qp.lb), torch.where(held, level, qp.ub)
        best = replace(qp, lb=lb, ub=ub, check_values=False)
        start = torch.from_numpy(active).reshape(*batch, n_g).to(qp.lb.device)
        solution = solve(best, fixed, n_kept, solver, "mask", start)
        status = solution.status.reshape(-1).cpu().numpy().copy()
        status = np.where((status == 0) | ~found, STATUSES[outcomes], status)
        failed = (status != Status.SOLVED) & (status != Status.NODE_LIMIT)
        if failed.any() and on_failure != "mask":
            report(np.where(failed, status, 0), batch, on_failure)
        if (capped := status == Status.NODE_LIMIT).any() and on_failure != "mask":
            text = (
                f"{capped.sum()} of {B} plans may not be the best: {Status.NODE_LIMIT.explanation}."
            )
            warnings.warn(text, RuntimeWarning, stacklevel=4)
        to = qp.q.device
        lost = torch.from_numpy(failed).reshape(batch).to(to)
        of_starts = torch.from_numpy(costs).reshape(batch).to(to, qp.q.dtype)
        value = torch.where(lost, torch.inf, solution.value + of_starts)
        known = F.pad(fixed.detach(), (0, qp.n_z - fixed.shape[-1])).expand_as(solution.z)
        parts = {name: getattr(solution, name) for name in ("chi", "lam", "xi")}
        parts = {name: torch.where(lost[..., None], 0.0, x) for name, x in parts.items()}
        gap = torch.from_numpy(gaps * capped).reshape(batch).to(to, qp.q.dtype)
        return replace(
            solution,
            **parts,
            qp=best,
            z=torch.where(lost[..., None], known.to(qp.q.dtype), solution.z),
            active=solution.active.masked_fill(lost[..., None], UNKNOWN),
            value=value,
            status=torch.from_numpy(status).reshape(batch).to(to),
            value_error=solution.value_error + gap / value.detach().abs().clamp(min=1e-12),
            iterations=torch.from_numpy(nodes).reshape(batch).to(to),
        )

    def search(
        self, programs: Programs, runs: np.ndarray, hint: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Return places of the levels, active sets, costs of starts, outcomes, nodes and gaps."""
        prepared, n_f, theta, group = (
            programs.prepared,
            programs.n_f,
            programs.theta,
            programs.group,
        )
        qps, of, least = programs.reduced_qps(), prepared.reduced(n_f).rows, 0.0
        if prepared.sizes(n_f).shift.any() and (slope := np.abs(qps.g).max(initial=0.0)) > 0:
            # A power of two, as each is kept.
            least = 2.0 ** np.ceil(np.log2(CURVATURE * slope / np.abs(self.values).max()))
        K, unit, to_free = prepared.dual(n_f, float(least))
        scale = unit[group]
        lb, ub = theta.lb[:, of], theta.ub[:, of]
        with np.errstate(invalid="ignore"):
            shift = np.where(
                np.isfinite(lb), lb - qps.l, np.where(np.isfinite(ub), ub - qps.u, 0.0)
            )
        free = shift / scale - np.einsum("bij,bj->bi", to_free[group], qps.g)
        lower, upper, w = lb / scale, ub / scale, qps.w * scale
        place = np.full(theta.G.shape[1], -1)
        place[of] = np.arange(len(of))
        rows = place[self.rows]
        given = np.einsum("bmi,bi->bm", theta.G[group][:, self.rows[:, 0], :n_f], programs.fixed)
        off = np.abs(given[:, :, None] - self.values)
        reach = self.values[np.arange(len(self.counts)), self.counts - 1] - self.values[:, 0]
        off[:, np.arange(off.shape[2]) >= self.counts[:, None]] = np.inf
        fixed = np.where(off.min(-1) <= ON_LEVEL * reach, off.argmin(-1), -1)
        places, lam, costs, outcomes, nodes, gaps = kernel.search(
            K, unit, group, free, lower, upper, w, rows, self.values, self.counts, self.rules,
            self.starts, runs, fixed, hint, self.max_nodes,
        )  # fmt: skip
        active = np.zeros((len(group), theta.G.shape[1]), np.int8)
        saturated = np.abs(lam) >= (1 - kernel.GAIN) * w
        active[:, of] = np.where(saturated, 2 * np.sign(lam), np.sign(lam))
        held = self.rows[rows >= 0]
        active[:, held] = np.where(active[:, held] == 0, 1, active[:, held])
        return places, active, costs, outcomes, nodes, gaps


class Searches:
    """Searches for the best plan with a theta at rest, one after the other, in NumPy alone.

    ``n_kept`` and ``solver`` are those of `torch_qpmpc.qp.solve.solve`.
    """

    def __init__(self, levels: Levels, qp: QuadraticProgram, n_kept: int, solver: str) -> None:
        self._levels, self._solver = levels, solver
        self._prepared = prepared_for([to_numpy(x.detach()) for x in qp.tensors()], n_kept)

    def solve(
        self, fixed: np.ndarray, runs: np.ndarray, hint: np.ndarray | None = None
    ) -> tuple[BatchSolution, np.ndarray]:
        """Return the best plan's solution, and the places of its levels ``(m, S)``.

        Args:
            fixed: the first entries of z, ``(1, n_f)``.
            runs, hint: as in `Levels.solve`, ``(m,)`` and ``(m, S)``.
        """
        levels, programs = self._levels, self._of(fixed, self._prepared)
        hint = np.full(levels.rows.shape, -1) if hint is None else hint
        places, active, _, (outcome,), *_ = levels.search(programs, runs[None], hint[None])
        if outcome not in (kernel.BEST, kernel.CAPPED):
            return programs.unsolved(int(STATUSES[outcome])), places[0]
        solution = self.held(fixed, places[0], active)
        if not solution.status[0]:
            solution.status[0] = STATUSES[outcome]
        return solution, places[0]

    def held(
        self, fixed: np.ndarray, places: np.ndarray, active: np.ndarray | None = None
    ) -> BatchSolution:
        """Return the solution of the QP that is held at the levels of a plan, ``(m, S)``."""
        lb, ub = self._prepared.theta.lb.copy(), self._prepared.theta.ub.copy()
        rows, values = self._levels.rows, self._levels.values
        lb[:, rows] = ub[:, rows] = np.take_along_axis(values, places, 1)
        programs = self._of(fixed, self._prepared.bounded(lb, ub))
        return solve_programs(programs, self._solver, active)

    def _of(self, fixed: np.ndarray, prepared: Prepared) -> Programs:
        return Programs(prepared, np.zeros(1, np.int64), fixed)


def check_used(levels: str, given: dict[str, Any]) -> None:
    """Raise `QPError` if minimum times and the like are ``given`` to actions without ``levels``."""
    for name, value in given.items():
        if value is not None and np.any(np.not_equal(value, DEFAULTS[name])):
            raise QPError.expected(name, repr(value), f"{levels} beside it", f"Pass {levels}.")


def read_levels(value: Any) -> tuple[tuple[float, ...], ...]:
    """Read the levels of each action, none for an action between its bounds.

    Raises:
        QPError: they are not ascending.
    """
    want = "for each action ascending numbers, or None"
    try:
        levels = tuple(() if x is None else tuple(float(v) for v in x) for x in value)
    except (TypeError, ValueError) as error:
        raise QPError.expected("action_levels", repr(value), want) from error
    for own in levels:
        steps = np.diff(own)
        if own and not (len(own) <= MOST and np.isfinite(own).all() and (steps > 0).all()):
            remedy = "The lowest level is off." + f" There may be {MOST}." * (len(own) > MOST)
            raise QPError.expected("action_levels", f"{[*own]}", want, remedy)
    return levels


def _numbers(name: str, value: Any, n_u: int) -> np.ndarray:
    """Return a number for each action.

    Raises:
        QPError: they are not finite numbers >= 0, one or ``n_u``.
    """
    try:
        numbers = np.broadcast_to(np.asarray(value, float), n_u)
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not (np.isfinite(numbers) & (numbers >= 0)).all():
        raise QPError.expected(name, repr(value), f"a number >= 0, or {n_u} of them")
    return numbers
