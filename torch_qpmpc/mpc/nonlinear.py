"""Nonlinear MPC: any function x+ = f(x, u, d) as the model, by sequential quadratic programming.

V(s) is a local minimum, over plans u_0, .., u_{N-1}, of theta's cost and f's stage cost l,

    1/2 z'Hz + q'z + c + w'sigma + sum_k gamma^k l(x_k, u_k, d_k),  x_{k+1} = f(x_k, u_k, d_k),

with the rows of theta. The QP along a plan has f's Jacobians as A_k, B_k and E_k, and the positive
parts of l's Hessians (Gauss and Newton) in units of the changes that actions make, with a proximal
term (Levenberg and Marquardt). Its step, shortened until the cost and the priced violations of hard
rows fall, leads to the next plan. All plans are simulations of f.

Where this converges, the QP's multipliers are those of the nonlinear program. They give the
gradient of V, and the QP's KKT system that of the plan, with the Hessian of the Lagrangian, f's
curvature included, in place of H (Fiacco, 1976).
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torch_qpmpc.checks import check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.learned import LearnedModel
from torch_qpmpc.mpc.layout import Layout, banded_matrix
from torch_qpmpc.qp.batching import times
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, to_tensor
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.solve import report
from torch_qpmpc.qp.program import NDIMS, QuadraticProgram, Status, broadcast
from torch_qpmpc.qp.solution import QPSolution, saturated_rows
from torch_qpmpc.qp.solve import Eager, solve
from torch_qpmpc.qp.tracing import is_eager

#: The number of random plans, and for how many steps they hold an action.
RANDOM, HOLD = 6, 5
#: The fractions of a step that are tried.
FRACTIONS = (1.0, 0.5, 0.2, 0.04)
#: So many derivatives of networks are computed at once: more do not fit in the caches.
ROWS = 128
#: The proximal term in terms of H's diagonal: first, least, most, and its change by each QP.
FIRST, LEAST, MOST, CHANGE = 1e-2, 1e-9, 1e4, 4.0
#: A converged plan's step, and a rise of the cost that is rounding, relatively; too large a state.
SETTLED, ROUNDING, OVERFLOW = 1e-7, 1e-11, 1e50
#: The price of a hard row's violation: relative to its largest multiplier, and before there is one
#: to the cost of a violation by the row's bound; and the share of it that infeasible QPs may leave.
PRICE, FIRM, SLIP = 2.0, 0.3, 1e-3
#: The least eigenvalue of a definite Hessian, multiplier of an active row, and change of a state by
#: actions, relatively.
DEFINITE, ACTIVE, LEVER = 1e-9, 1e-8, 1e-3


class RungeKutta(nn.Module):
    """The state after ``dt`` of x' = derivative(x, u) or derivative(x, u, d): `QPMPC`'s dynamics.

    Args:
        derivative: x' ``(*batch, n_x)`` of x, u and d with these leading dimensions.
        dt: the time between two actions.
        steps: the number of equal steps, of fourth order.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> f = qm.RungeKutta(lambda x, u: u - x, dt=0.1)
        >>> f(torch.ones(1), torch.zeros(1))  # exp(-0.1)
        tensor([0.9048])
    """

    def __init__(self, derivative: Callable[..., Tensor], dt: float, steps: int = 1) -> None:
        super().__init__()
        check_whole("steps", steps, 1)
        self.derivative, self.dt, self.steps = derivative, dt, steps

    def forward(self, x: Tensor, *others: Tensor) -> Tensor:
        """Return the state after x ``(*batch, n_x)``; ``others`` are u and, with a preview, d."""
        h = self.dt / self.steps
        for _ in range(self.steps):
            k_1 = self.derivative(x, *others)
            k_2 = self.derivative(x + h / 2 * k_1, *others)
            k_3 = self.derivative(x + h / 2 * k_2, *others)
            k_4 = self.derivative(x + h * k_3, *others)
            x = x + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4)
        return x


@dataclass(frozen=True, repr=False)
class PlanSolution(QPSolution):
    """The solution of the last QP along a plan, or that plan where it has not converged.

    Attributes:
        plan: the actions ``(*batch, N, n_u)``, a ``warm_start`` of the same state.
        converged: True where the last QP left its plan in place, ``(*batch,)``.
        defect: the largest of |x_{k+1} - f(x_k, u_k, d_k)| in z, ``(*batch,)``.
        strict: True where the Lagrangian's Hessian is positive definite in all directions that the
            active rows leave free, ``(*batch,)``; elsewhere only the value has a gradient, and
            others are zero. None if no gradient is recorded.
    """

    plan: Tensor
    converged: Tensor
    defect: Tensor
    strict: Tensor | None

    @property
    def later(self) -> Tensor:
        """The plan one step later, ``(*batch, N n_u)``, which repeats its last action."""
        return torch.cat((self.plan[..., 1:, :], self.plan[..., -1:, :]), -2).flatten(-2)

    def warn(self) -> None:
        """Warn of plans without a gradient, if gradients are recorded."""
        if self.strict is not None and (count := int((~self.strict).sum())):
            text = f"{count} of {self.strict.numel()} plans have a gradient of zero: the Hessian of"
            text += " the Lagrangian is not positive definite along their active rows"
            warnings.warn(text, RuntimeWarning, stacklevel=4)


class Known(Eager):
    """A known solution as a function of the QP that it solves; it is the last argument."""

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, ...]:
        return arguments[-1]


class SequentialQP(nn.Module):
    """The search for plans, and the QPs along them.

    Args:
        dynamics: f, see `QPMPC`.
        layout: the sizes.
        gamma: the discount of stage costs.
        iterations: the most QPs of a call with a plan.
    """

    entries: Tensor
    C: Tensor
    held: Tensor
    powers: Tensor

    def __init__(
        self, dynamics: Callable[..., Any], layout: Layout, gamma: float, iterations: int = 1
    ) -> None:
        super().__init__()
        if isinstance(dynamics, dict):  # of a file
            dynamics = LearnedModel(**dynamics)
        if not callable(dynamics):
            raise QPError.expected("dynamics", repr(dynamics), "a function f(x, u) of tensors")
        check_whole("iterations", iterations, 1)
        self.dynamics, self.layout, self.iterations = dynamics, layout, iterations
        self.sizes = layout.n_d, layout.n_x, layout.n_u
        zero = torch.zeros(layout.n_x, layout.n_d + layout.n, dtype=torch.float64)
        E, A, B = zero.split(self.sizes, -1)
        w = zero.expand(len(A) + 1, -1, -1).clone().requires_grad_()
        shapes = [(len(w), *A.shape), (len(w), len(A))]
        try:
            with torch.enable_grad():
                after, cost = self.stage(*w.split(self.sizes, -1))
            got, sloped = [tuple(after.shape), *shapes[1:]], after.requires_grad
            got = got if cost is None else [got[0], tuple(cost.shape)]
        except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            want, remedy = "x+ or (x+, l) of float64 (*batch, n)", "Check n_x, n_u; use double()."
            raise QPError.expected("dynamics", repr(error), want, remedy) from error
        if got != shapes or not sloped:
            what = f"x+ and l of shapes {got}" if sloped else "x+ without a gradient"
            remedy = "Index the last dimension, x[..., 0], and do not detach."
            raise QPError.expected("dynamics", what, f"{shapes}, with a gradient", remedy)
        k = torch.arange(layout.horizon)
        d, plan = (first + n * k for first, n in ((0, layout.n_d), (layout.n_preview, layout.n)))
        columns = [x.unsqueeze(1) + torch.arange(n) for x, n in ((d, layout.n_d), (plan, layout.n))]
        self.register_buffer("entries", torch.cat(columns, 1), persistent=False)
        self.register_buffer("C", banded_matrix(A, B, layout.horizon, E), persistent=False)
        self.register_buffer("powers", float(gamma) ** k.double(), persistent=False)
        held = k.masked_fill(layout.repeating, 0).cummax(0).values
        self.register_buffer("held", held, persistent=False)

    def stage(
        self, d: Tensor, x: Tensor, u: Tensor, *, f: Callable[..., Any] | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """Return the next x, and the stage cost if there is one, of the dynamics or an equal f."""
        out = (f or self.dynamics)(*(x, u, d)[: 2 + bool(self.layout.n_d)])
        return out if isinstance(out, tuple) else (out, None)

    def outputs(self, w: Tensor) -> Tensor:
        """Return [x+, l] ``(.., n_x + 1)`` of w = [d, x, u]."""
        after, cost = self.stage(*w.split(self.sizes, -1))
        cost = w.new_zeros(w.shape[:-1]) if cost is None else cost
        return torch.cat((after, cost.unsqueeze(-1)), -1).to(w)

    def simulated(self, p: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return z ``(.., n_z)`` of plans u ``(.., N, n_u)`` from p, and the sums of l."""
        layout, p = self.layout, p.expand(*u.shape[:-2], -1)
        d = p[..., : layout.n_preview].unflatten(-1, (layout.horizon + 1, layout.n_d)).unbind(-2)
        x, costs, states = p[..., layout.n_preview :], [], []
        f = self.dynamics.folded() if isinstance(self.dynamics, LearnedModel) else self.dynamics
        for d_k, u_k in zip(d[:-1], u.unbind(-2), strict=True):
            x, cost = self.stage(d_k, x, u_k, f=f)
            states.append(x)
            costs += [] if cost is None else [cost]
        z = torch.cat((p, torch.cat((u, torch.stack(states, -2).to(u)), -1).flatten(-2)), -1)
        return z, torch.stack(costs, -1).to(u) @ self.powers if costs else z.new_zeros(z.shape[:-1])

    def curvature(self, w: Tensor, weights: Tensor) -> Tensor:
        """Return the Hessians of ``weights``'[x+, l] in w, ``(.., n, n)``."""

        def slope(w: Tensor) -> Tensor:
            out = self.outputs(w)
            options = {"create_graph": True, "materialize_grads": True}
            return torch.autograd.grad(out, w, weights.expand_as(out), **options)[0]

        W = _jacobian(slope, w, w.shape[-1])[1].detach()
        return (W + W.mT) / 2

    def moved(self, of_x: Tensor, most: Tensor) -> Tensor:
        """Return how far actions move w ``(B, N, n)``: roots of Gramians, at most ``most``."""
        _, A, B = of_x.split(self.sizes, -1)
        B, S = B * most[:, None, None, -self.layout.n_u :], [torch.zeros_like(A[:, 0])]
        for A_k, of_u in zip(A[:, :-1].unbind(1), (B @ B.mT).unbind(1), strict=False):
            S.append(torch.baddbmm(of_u, A_k @ S[-1], A_k.mT))
        sizes = torch.stack(S, 1).diagonal(dim1=2, dim2=3).sqrt().nan_to_num(torch.inf)
        sizes = F.pad(sizes, self.sizes[::2], value=torch.inf)
        return sizes.maximum(LEVER * most.unsqueeze(1)).minimum(most.unsqueeze(1))

    def along(self, qp: QuadraticProgram, z: Tensor, chi: Any, most: Any) -> QuadraticProgram:
        """Return the QP along z ``(B, n_z)``, with the ranges ``most`` ``(B, n)`` for `moved`.

        With multipliers ``chi`` of a solution z, it has the derivatives of the nonlinear program:
        H is the Lagrangian's Hessian, and other parts depend on the parameters of the dynamics.
        """
        w, powers, n_c = z.detach()[:, self.entries], self.powers.unsqueeze(-1), len(self.C)
        n_d, n_x, W = self.layout.n_d, self.layout.n_x, None
        if chi is None and isinstance(self.dynamics, LearnedModel):
            parts = [of_networks(self.dynamics, x) for x in w.flatten(0, 1).split(ROWS)]
            out, J, W = (torch.cat(x).unflatten(0, w.shape[:2]) for x in zip(*parts, strict=True))
            out = F.pad(out, (0, n_x + 1 - out.shape[-1]))
            J = F.pad(J, (0, 0, 0, n_x + 1 - J.shape[-2]))
            J[..., :n_x, n_d : n_d + n_x] += torch.eye(n_x).to(J)
            out[..., :n_x] += w[..., n_d : n_d + n_x]
        else:
            out, J = _jacobian(self.outputs, w, n_x + 1, chi is not None)
        of_x, of_l = J[..., :-1, :], J[..., -1, :]
        C = self.C.unflatten(0, (len(powers), -1)).expand(len(z), -1, -1, -1)
        C = C.scatter(-1, self.entries.unsqueeze(1).expand_as(of_x), of_x).flatten(1, 2)
        b = (times(of_x, w) - out[..., :-1]).flatten(1)
        C = torch.cat((C, qp.C[..., n_c:, :].expand(len(z), -1, -1)), 1)  # rows of blocks
        b = torch.cat((b, qp.b[..., n_c:].expand(len(z), -1)), 1)
        q, H, whole = powers * of_l, None, qp.H.expand(len(z), -1, -1).clone()
        c = self.powers * out[..., -1] - (w * q).sum(-1)
        if chi is not None:
            chi = chi[:, :n_c].detach().unflatten(1, (len(powers), -1))
            H = self.curvature(w, torch.cat((chi, powers.expand(len(z), -1, 1)), -1))
        elif of_l.any():
            if W is None:
                W = self.curvature(w, F.pad(torch.ones_like(powers), (n_x, 0)).expand_as(out))
            size = self.moved(of_x, most).unsqueeze(-1)
            values, vectors = torch.linalg.eigh((size * W * size.mT).nan_to_num(0, 0, 0))
            vectors = vectors / torch.where(size > 0, size, torch.inf)
            H = (vectors * (powers * values.clamp(min=0)).unsqueeze(-2)) @ vectors.mT
            q, c = q - times(H, w), c + (w * times(H, w)).sum(-1) / 2
        if H is not None:
            whole[:, self.entries.unsqueeze(-1), self.entries.unsqueeze(-2)] += H
        q = qp.q + torch.zeros_like(z).index_copy(1, self.entries.flatten(), q.flatten(1))
        return replace(qp, H=whole, q=q, c=qp.c + c.sum(-1), C=C, b=b, check_values=False)

    def solve(
        self,
        qp: QuadraticProgram,
        fixed: Tensor,
        n_kept: int,
        solver: str,
        on_failure: str,
        warm_start: Any = None,
    ) -> PlanSolution:
        """Return the solution along the plan that the search from ``warm_start`` ends with.

        Arguments are as in `torch_qpmpc.qp.solve.solve`; a plan is ``(*batch, N, n_u)``, flat or
        not, or that of a `PlanSolution`. With NaN, or what is no plan, the search starts cold.
        """
        if not is_eager(theta := (*qp.tensors(), fixed)):
            want = "one outside torch.compile, torch.func and losses without deactivate_vmap=True"
            raise QPError.expected("dynamics", "a traced call", want)
        N, n_u, batch = self.layout.horizon, self.layout.n_u, fixed.shape[:-1]
        batch = broadcast(qp.batch_shape, batch)
        flat = [
            x if x.ndim == n else x.expand(*batch, *x.shape[x.ndim - n :]).flatten(0, -n - 1)
            for x, n in zip(qp.tensors(), NDIMS, strict=True)
        ]
        flat = QuadraticProgram(*flat, check_values=False)
        fixed = fixed.expand(*batch, -1).reshape(batch.numel(), fixed.shape[-1])
        plan = warm_start.plan if isinstance(warm_start, PlanSolution) else warm_start
        if not isinstance(plan, Tensor) or not plan.is_floating_point():
            plan = fixed.new_full((len(fixed), N, n_u), torch.nan)
        elif plan.numel() != len(fixed) * N * n_u:
            want = f"a plan ({N}, {n_u}) for each of {len(fixed)} states"
            raise QPError.expected("warm_start", f"shape {tuple(plan.shape)}", want)
        with torch.no_grad():
            plan = plan.to(fixed).reshape(len(fixed), N, n_u)
            u, known, converged = self._search(flat, fixed, plan, n_kept, solver)
            w, x = known.z[:, self.entries], self.layout.predicted(known.z)[0][:, 1:]
            defect = torch.zeros_like(known.value)  # of what `simulated` returns
            if converged.any():
                off = self.outputs(w[converged])[..., :-1] - x[converged]
                defect[converged] = off.abs().amax((1, 2))
        if on_failure != "mask" and known.status.any():
            report(known.status.cpu().numpy(), batch, on_failure)
        strict = None
        if torch.is_grad_enabled() and any(x.requires_grad for x in (*theta, *self.parameters())):
            own = self.along(flat, known.z, known.chi, None)
            solved = known.status == Status.SOLVED
            strict = torch.zeros_like(solved)
            z, lam = known.z[solved], known.lam[solved]
            strict[solved] = _strict(_taken(own, solved), fixed[solved], z, lam)
            value, *rest = Known.apply(*own.tensors(), fixed, None, n_kept, solver, known)
            known = (value, *(x.where(strict[:, None], x.detach()) for x in rest[:4]), *rest[4:])
        parts = (*known, u, converged, defect, strict)
        parts = (x if x is None else x.reshape((*batch, *x.shape[1:])) for x in parts)
        return PlanSolution(qp, *parts)

    def _search(
        self, qp: QuadraticProgram, fixed: Tensor, plan: Tensor, n_kept: int, solver: str
    ) -> tuple[Tensor, BatchSolution, Tensor]:
        """Return the best plans found, their QPs' solutions, and the converged."""
        layout, B, every = self.layout, len(fixed), torch.arange(len(fixed))
        n_p, n, N, p = layout.n_p, layout.n, layout.horizon, fixed[:, : layout.n_p]
        of_x = F.pad(torch.arange(N * n) % n >= layout.n_u, (n_p, 0), value=True)
        hard, moved = (x.expand(B, -1) for x in (qp.w.isinf(), (qp.G * of_x != 0).any(-1)))
        of_u, hard = hard & ~moved, hard & moved  # those of u alone no plan may violate
        price = torch.where(qp.w.isinf(), 0.0, qp.w).repeat(B if qp.w.ndim == 1 else 1, 1)
        bound = torch.stack((qp.lb, qp.ub)).abs().nan_to_num(posinf=0.0).amax(0)
        bound = torch.where(bound > 0, bound, 1.0).expand(B, -1)

        def rated(index: Tensor, z: Tensor, costs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            """Return z ``(len(index), K, n_z)``, its cost and the violations of rows."""
            own = _taken(qp, index, 1)
            y = times(own.G, z)
            over = torch.maximum(own.lb - y, y - own.ub).relu()
            far = (over > ROUNDING**0.5 * bound[index].unsqueeze(1)) & of_u[index].unsqueeze(1)
            costs = costs + own.c + (z * (times(own.H, z) / 2 + own.q)).sum(-1)
            return z, costs, over.masked_fill(far, torch.inf)

        def merit(price: Tensor, costs: Tensor, over: Tensor) -> Tensor:
            """Return the costs with the prices of violations ``(.., n_g)``."""
            return (costs + (price * over).sum(-1)).nan_to_num(torch.inf, torch.inf, torch.inf)

        tries = torch.cat((plan.unsqueeze(1), self._plans(qp).expand(B, -1, -1, -1)), 1)
        tries = torch.where(tries.isnan(), tries[:, 1:2], tries)
        if fixed.shape[1] > n_p:
            tries[:, :, 0] = fixed[:, None, n_p:]
        tries = tries[:, :, self.held]
        z, costs, over = rated(every, *self.simulated(p.unsqueeze(1), tries))
        w = z[:, 1:, self.entries[:, layout.n_d :]].nan_to_num(0, 0, 0)
        most = w.amax((1, 2)) - w.amin((1, 2))
        most = F.pad(most.where(most > ROUNDING * w.abs().amax((1, 2)), 0.0), (layout.n_d, 0))
        least = merit(price[:, None], costs, over).amin(1, keepdim=True)
        price = torch.where(hard, FIRM * least.abs().nan_to_num(posinf=1.0) / bound, price)
        best = merit(price[:, None], costs, over).argmin(1)
        u, z, costs, over = (x[every, best] for x in (tries, z, costs, over))
        far = ~(z.abs() < OVERFLOW).all(1)
        z[far, n_p:], costs[far] = 0.0, torch.inf
        pull, parts = fixed.new_full((B,), FIRST), []
        (converged, done), failed = torch.zeros(2, B, dtype=torch.bool), torch.zeros_like(every)
        for _ in range(self.iterations):
            if not len(todo := (~done).nonzero().squeeze(1)) and parts:
                break
            near = self.along(_taken(qp, todo), z[todo], None, most[todo])
            size = near.H.diagonal(dim1=1, dim2=2)
            of_after = layout.predicted(size)[0][:, 1:].flatten(1)
            of_before = times(near.C[:, : len(self.C)].mT.square(), of_after)
            size = pull[todo, None] * size.maximum(1e-3 * of_before)
            near.H.diagonal(dim1=1, dim2=2).add_(size)
            near.q.sub_(size * z[todo])
            near.c.add_((size * z[todo] ** 2).sum(-1) / 2)
            solution = solve(near, fixed[todo], n_kept, solver, "mask", None)
            failed[todo], stuck = solution.status, (~solution.solved).unsqueeze(1) & hard[todo]
            if stuck.any():  # along a plan, rows may contradict each other that others keep
                near = replace(near, w=torch.where(stuck, price[todo], near.w), check_values=False)
                solution = solve(near, fixed[todo], n_kept, solver, "mask", None)
            solved, among = solution.solved, torch.arange(len(todo))
            own = [getattr(solution, name) for name in BatchSolution._fields]
            for part, x in zip(parts, own, strict=False):  # none at first
                part[todo[solved]] = x[solved]
            parts = parts or own
            lam = torch.where(hard[todo] & solved.unsqueeze(1), PRICE * solution.lam.abs(), 0)
            price[todo] = price[todo].maximum(lam)
            box = solution.z[:, layout.n_preview :]  # the entries of G's first rows
            low, high, firm = (x[..., : box.shape[1]] for x in (near.lb, near.ub, of_u[todo]))
            box = F.pad(box.clamp(low, high).where(firm, box), (layout.n_preview, 0))
            step = (layout.predicted(box)[1] - u[todo]) * solved[:, None, None]
            tries = torch.stack([u[todo] + share * step for share in FRACTIONS], 1)
            found = rated(todo, *self.simulated(p[todo].unsqueeze(1), tries))
            before = merit(price, costs, over)[todo]
            after, best = merit(price[todo, None], *found[1:]).min(1)
            force, change = times(near.H, z[todo]), solution.z - z[todo]
            scale = before.abs() + (z[todo] * force).sum(-1)
            better = solved & after.isfinite() & (after <= before + ROUNDING * scale)
            small = (step.abs().amax(1) <= SETTLED * u[todo].abs().amax(1)).all(1)
            forces = times(near.H, change), ROUNDING * (force + near.q)
            small |= ((torch.stack(forces) * change).sum(-1).abs() <= ROUNDING**2 * scale).all(0)
            for own, new in zip((u, z, costs, over), (tries, *found), strict=True):
                own[todo[better]] = new[among, best][better]
            converged[todo] = solved & small & (pull[todo] <= 1) & before.isfinite()
            pull[todo] *= torch.where(better, 1 / CHANGE, CHANGE)
            pull.clamp_(LEAST)
            done[todo] = converged[todo] | (pull[todo] > MOST)
        kept = BatchSolution(*parts)
        left = (~converged & (kept.status == 0)).nonzero().squeeze(1)
        kept.value[left] = merit(price, costs, over)[left]  # the plan in place of the QP's
        kept.z[left] = z[left]
        kept.status[left[kept.value[left].isinf()]] = int(Status.INVALID_DATA)
        y = times(qp.G, kept.z)
        over = (hard & (torch.maximum(qp.lb - y, y - qp.ub) > SLIP * bound)).any(1)
        status = torch.where(over & (kept.status == 0), failed, kept.status)
        return u, kept._replace(status=status), converged

    def _plans(self, qp: QuadraticProgram) -> Tensor:
        """Return plans ``(.., K, N, n_u)``, held at zero and random within the bounds."""
        N, n_x, n = self.layout.horizon, self.layout.n_x, self.layout.n
        low, high = (x[..., : N * n].unflatten(-1, (1, N, n))[..., n_x:] for x in (qp.lb, qp.ub))
        low = torch.where(low.isfinite(), low, high.where(high.isfinite(), 1.0) - 2)
        high = torch.where(high.isfinite(), high, low + 2)
        generator = torch.Generator().manual_seed(0)
        share = torch.rand(RANDOM, -(-N // HOLD), self.layout.n_u, generator=generator)
        share = share.repeat_interleave(HOLD, 1)[:, :N].to(low)
        return torch.cat((torch.zeros_like(low).clamp(low, high), low + share * (high - low)), -3)


def linearised(dynamics: Any, layout: Layout, w: Tensor | None = None) -> dict[str, Tensor]:
    """Return A, B, E and the offset at w = [d; x; u], by default the origin, by name."""
    model = SequentialQP(dynamics, layout, 1.0)
    w = torch.zeros(layout.n_d + layout.n, dtype=torch.float64) if w is None else w
    out, J = _jacobian(model.outputs, w[None], layout.n_x + 1)
    E, A, B = J[0, :-1].split(model.sizes, -1)
    return {"A": A, "B": B, "E": E, "offset": out[0, :-1] - J[0, :-1] @ w}


def _jacobian(f: Any, w: Tensor, size: int, graph: bool = False) -> tuple[Tensor, Tensor]:
    """Return a function f of w ``(.., n)`` with ``size`` outputs, and its Jacobian.

    One pass of a copy of w for each output: the function may have any operations.
    """
    with torch.enable_grad():
        copies = w.detach().expand(size, *w.shape).requires_grad_()
        out = f(copies) + 0 * copies.sum(-1, keepdim=True)  # depends on w in any case
        units = torch.eye(size).to(w).reshape(size, *(1,) * (w.ndim - 1), size).expand_as(out)
        (J,) = torch.autograd.grad(out, copies, units, create_graph=graph, materialize_grads=True)
    return (out[0] if graph else out[0].detach()), J.movedim(0, -2)


def of_networks(model: LearnedModel, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return what automatic differentiation of a model does, in a fraction of its time.

    They are its change of x, and its l if there is one, ``(R, m)`` at w = [d; x; u] ``(R, n)``,
    their Jacobian ``(R, m, n)``, and the Hessian ``(R, n, n)`` of the last of these entries.
    """
    v, R, n, m = (w - model.middle) / model.size, *w.shape, model.base.shape[1]
    J, hessian = model.base[1 : 1 + n].mT.expand(R, m, n), w.new_zeros(n, n)
    if model.base[1 + n :].any():
        rows, columns = torch.triu_indices(n, n)
        products = w.new_zeros(m, n, n)
        products[:, rows, columns] = model.base[1 + n :].mT
        products = products + products.mT
        J, hessian = J + (products @ v.mT).movedim(-1, 0), products[-1]
    out = model.base[0] + times(J + model.base[1 : 1 + n].mT, v) / 2
    if model.depth:
        W_1, b_1, W_2, b_2, W_3, b_3 = (getattr(model, f"layer_{i}") for i in range(model.depth))
        size = W_2.shape[:2]  # of the networks' hidden units
        one = _silu(torch.addmm(b_1, v, W_1))
        hidden = one[0].view(R, *size).movedim(1, 0)
        two = [x.movedim(0, 1).flatten(1) for x in _silu(torch.baddbmm(b_2, hidden, W_2))]
        out = out + torch.addmm(b_3, two[0], W_3)
        inner = (W_1 * one[1].unsqueeze(1)).view(R * n, *size).movedim(1, 0).bmm(W_2)
        inner = inner.movedim(0, 1).reshape(R, n, len(b_1))
        J = J + ((inner * two[1].unsqueeze(1)).flatten(0, 1) @ W_3).view(R, n, m).mT
        first, second = (x * W_3[:, -1] for x in two[1:])
        hessian = hessian + (inner * second.unsqueeze(1)) @ inner.mT
        first = first.view(R, *size).movedim(1, 0).bmm(W_2.mT).movedim(0, 1).flatten(1)
        hessian = hessian + (W_1 * (first * one[2]).unsqueeze(1)) @ W_1.mT
    J, hessian = J / model.size, hessian / model.size / model.size.unsqueeze(-1)
    return out, J, hessian.expand(R, n, n)


def _silu(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x sigmoid(x) and its first two derivatives."""
    y = x.sigmoid()
    slope = y * (1 - y)
    return x * y, y + x * slope, slope * (2 + x * (1 - 2 * y))


def _taken(qp: QuadraticProgram, index: Any, more: int = 0) -> QuadraticProgram:
    """Return the QPs at ``index``, detached, with ``more`` dimensions after the batch's."""
    parts = [
        x.detach() if x.ndim == n else x.detach()[index].unflatten(0, (-1, *(1,) * more))
        for x, n in zip(qp.tensors(), NDIMS, strict=True)
    ]
    return QuadraticProgram(*parts, check_values=False)


def _strict(qp: QuadraticProgram, fixed: Tensor, z: Tensor, lam: Tensor) -> Tensor:
    """Return the mask of plans whose Hessian is positive definite where active rows leave them."""
    theta, n_f = qp.tensors(), fixed.shape[-1]
    programs, _ = Programs.of(*theta, fixed.detach(), n_kept=n_f)
    condensed = programs.prepared.condensed(n_f)
    H, G = (to_tensor(x)[programs.group, :, n_f:] for x in (condensed.H, condensed.G))
    size = H[:, n_f:].diagonal(dim1=1, dim2=2).abs().sqrt()  # units in which no other has a part
    size = torch.where(size > 0, size, 1.0).unsqueeze(1)
    H, G = H[:, n_f:] / size / size.mT, G / size
    force = lam.abs() * G.norm(dim=-1)
    cost = (times(theta[0], z) * z).sum(-1, keepdim=True).abs().sqrt()
    held = force > ACTIVE * torch.cat((force, cost), dim=-1).amax(-1, keepdim=True)
    held = (held | (theta[6] >= theta[7])) & ~saturated_rows(lam, theta[8])
    rows = torch.where(held.unsqueeze(-1), F.normalize(G, dim=-1), 0)
    kept = torch.linalg.pinv(rows) @ rows
    free = torch.eye(H.shape[-1]).to(H) - kept
    return (torch.linalg.eigvalsh(free @ H @ free + kept) > DEFINITE).all(-1)
