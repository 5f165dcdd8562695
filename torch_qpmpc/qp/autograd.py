"""The QP as a differentiable function: `solve_qp`, and the envelope gradient of its value.

The optimal value's gradient is the Lagrangian's at the solution (eq:gradq): no linear system is
solved for it. With z, sigma, chi, upsilon, eta, xi as in `torch_qpmpc.qp.program`,

    dV/dH = 1/2 z z'   dV/dq = z    dV/dc = 1         dV/dC = chi z'   dV/db = -chi
    dV/dG = (eta - upsilon) z'      dV/dlb = upsilon  dV/dub = -eta    dV/dw = sigma
    dV/d(fixed) = -xi

A custom operator keeps the solver opaque to `torch.compile`, fake tensors and `vmap`; the
autograd Function round it makes it differentiable under `torch.func` as well, which a custom
operator alone is not.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from numbers import Integral
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.qp.batching import align, broadcast, listed, outer, sum_to, weighted_sum
from torch_qpmpc.qp.kernels import per_sample
from torch_qpmpc.qp.pipeline.batch import FlatPrograms
from torch_qpmpc.qp.pipeline.batch_solution import RawArrays, RawSolution
from torch_qpmpc.qp.pipeline.solve import CACHED, solve_programs
from torch_qpmpc.qp.program import (
    NDIMS,
    UNKNOWN,
    QPSolution,
    QuadraticProgram,
    Sizes,
    Status,
    slacks,
)
from torch_qpmpc.qp.sensitivity import (
    differentiable,
    is_differentiating,
    is_plain,
    is_traced,
    signed,
    traceable,
)
from torch_qpmpc.qp.solvers import backend
from torch_qpmpc.qp.tangents import value_tangent

ON_FAILURE = ("raise", "warn", "mask")
#: Event dimensions of the operator's tensors: H, q, c, C, b, G, lb, ub, w, fixed, a warm start.
EVENT_NDIMS = (*NDIMS, 1, 1)
N_THETA = 10
CPU = torch.device("cpu")
#: Position of ``keep`` among the operator's arguments, and how many follow theirs.
KEEP = 11
N_OTHERS = 4
#: value, z, sigma, chi, lam, xi, status, residual, iterations
Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def solve_qp(
    qp: QuadraticProgram,
    fixed: Tensor | None = None,
    *,
    solver: str = "proxqp",
    on_failure: str = "raise",
    warm_start: QPSolution | Tensor | None = None,
    keep: int | None = None,
) -> QPSolution:
    """Solve a batch of QPs (eq:qp2, eq:qp3); every answer is certified.

    Args:
        qp: the problems.
        fixed: values of the first n_f entries of z, ``(*batch, n_f)``: s for V, (s, a) for Q.
        solver: ``"proxqp"``, ``"daqp"``, ``"torch"`` or ``"qpsolvers:NAME"``. What its answer's
            certificate rejects is solved again by the others.
        on_failure: what an unsolved element does. ``"raise"`` a `SolverError`; ``"warn"`` and
            ``"mask"`` give it ``value = inf`` and no gradient, with and without a warning.
        warm_start: a solution of nearly the same QPs, or its ``active`` ``(*batch, n_g)``: tried
            before the solver is, for the whole batch at once. Saves time only.
        keep: leading entries of z that condensing leaves alone, at least n_f. A V and a Q that
            keep the same entries share one elimination of C z = b.

    Returns:
        The solution, differentiable in every tensor of ``qp`` and in ``fixed``: ``value`` by the
        envelope theorem, and twice; the rest by the KKT system (`torch_qpmpc.qp.sensitivity`).

    Raises:
        QPError: ``fixed`` or ``warm_start`` does not fit, or an argument is unknown.
        SolverError: with ``on_failure="raise"``, an element is infeasible, unbounded or not solved.

    References:
        Büskens and Maurer (2001), as cited at eq:gradq.
    """
    check_kind("qp", qp, QuadraticProgram, "Of a QPMPC: mpc.quadratic_program(), or mpc.solve(s).")
    for name, choice in (("solver", solver), ("on_failure", on_failure)):
        if not isinstance(choice, str):
            raise QPError.expected(name, repr(choice), "a name")
    if fixed is None:
        fixed = qp.q.new_zeros(0)
    theta = _operands(qp, fixed, qp.sizes)
    start = _checked_start(qp, fixed, warm_start)
    keep = _checked_keep(qp, fixed, keep)
    value, z, _, chi, lam, xi, status, residual, iterations = _solve(
        *theta, start, keep, solver, on_failure
    )
    if is_differentiating():
        z, lam, chi, xi = differentiable(z, lam, chi, xi, status, *theta, keep)
    return QPSolution(qp, value, z, chi, lam, xi, status, residual, iterations)


def optimal_value(
    qp: QuadraticProgram, fixed: Tensor, *, solver: str, on_failure: str, keep: int | None = None
) -> Tensor:
    """The optimal cost alone, ``(*batch,)``: `solve_qp` without the rest of the solution."""
    theta = _operands(qp, fixed, sizes := qp.sizes)
    given = (*theta, None, _checked_keep(qp, fixed, keep), solver, on_failure)
    return _solve_plain(given)[0] if _takes_kernels(sizes, given) else _solve(*given)[0]


def value_and_active_set(
    qp: QuadraticProgram,
    fixed: Tensor,
    *,
    solver: str,
    on_failure: str,
    warm_start: Tensor | None,
    keep: int | None = None,
) -> tuple[Tensor, Tensor]:
    """``value`` and ``active`` of `solve_qp`, of which only the former is differentiable."""
    start = _checked_start(qp, fixed, warm_start)
    keep = _checked_keep(qp, fixed, keep)
    given = (*_operands(qp, fixed, sizes := qp.sizes), start, keep, solver, on_failure)
    if _takes_kernels(sizes, given):
        value, found = _solve_plain(given)
        rows = per_sample.arrays(qp.G, qp.lb, qp.ub, qp.w)
        sets = per_sample.active_sets(found.z, found.lam, found.status, *rows, UNKNOWN)
        return value, torch.from_numpy(sets)
    value, z, _, chi, lam, xi, status, residual, iterations = _solve(*given)
    solution = QPSolution(qp, value, z, chi, lam, xi, status, residual, iterations)
    return value, solution.active


def _takes_kernels(sizes: Sizes, given: Sequence[Any]) -> bool:
    """Whether the operator's arguments are for kernels, and no more than reverse mode looks on."""
    return _is_for_kernels(sizes, given[0], given[N_THETA - 1]) and is_plain(given[:N_THETA])


def _is_for_kernels(sizes: Sizes, *tensors: Tensor) -> bool:
    """Whether one small theta is shared by a batch in float64 on the CPU, as one of theta shows.

    The products of large ones are for BLAS, and all cores.
    """
    *_, of_batch = tensors
    one = not sizes.batch_shape and of_batch.ndim == 2 and sizes.largest <= CACHED
    return one and all(x.is_cpu and x.dtype == torch.float64 for x in tensors)


def _solve_plain(given: Sequence[Any]) -> tuple[Tensor, RawArrays]:
    """The value alone, and the rest of the solution as arrays, which nobody else can change."""
    raw, _ = _solve_flat(*given)
    if not is_differentiating():
        return torch.from_numpy(raw.arrays.value), raw.arrays
    return Envelope.apply(raw, given[KEEP], *given[:N_THETA]), raw.arrays


def _solve(*arguments: Any) -> Outputs:
    # The Function's bookkeeping takes as long as solving some ten QPs.
    if not is_differentiating():
        return _solve_opaque(*arguments)
    return traceable(QPTangent, QPValue, solve_op)(*arguments)


def _operands(qp: QuadraticProgram, fixed: Tensor, sizes: Sizes) -> tuple[Tensor, ...]:
    if not isinstance(fixed, Tensor) or not fixed.is_floating_point():
        got = fixed.dtype if isinstance(fixed, Tensor) else type(fixed).__name__
        raise QPError.expected("fixed", got, "a floating-point torch.Tensor", "Convert it first.")
    if fixed.device != qp.q.device:
        got, remedy = f"a tensor on {fixed.device}", f"Move it: fixed.to({str(qp.q.device)!r})."
        raise QPError.expected("fixed", got, f"one on the QP's {qp.q.device}", remedy)
    if fixed.ndim == 0 or fixed.shape[-1] > qp.n_z:
        raise QPError.expected(
            "fixed",
            f"shape {tuple(fixed.shape)}",
            f"shape (*batch, n_f) with n_f <= n_z = {qp.n_z}",
        )
    try:
        broadcast(sizes.batch_shape, fixed.shape[:-1])
    except RuntimeError as error:
        raise QPError.expected(
            "fixed",
            f"shape {tuple(fixed.shape)}",
            f"leading dimensions that broadcast with the QP's batch {tuple(sizes.batch_shape)}",
        ) from error
    return (*qp.tensors(), fixed)


def _checked_start(
    qp: QuadraticProgram, fixed: Tensor, warm_start: QPSolution | Tensor | None
) -> Tensor | None:
    if warm_start is None:
        return None
    if not isinstance(warm_start, QPSolution | Tensor):
        got = type(warm_start).__name__
        raise QPError.expected("warm_start", got, "a QPSolution, or its `active`")
    active = warm_start if isinstance(warm_start, Tensor) else warm_start.active
    batch = broadcast(qp.batch_shape, fixed.shape[:-1])
    want = (*batch, qp.lb.shape[-1])
    if tuple(active.shape) != want or active.dtype != torch.int8:
        raise QPError.expected(
            "warm_start",
            f"shape {tuple(active.shape)} of {active.dtype}",
            f"{want} of torch.int8",
            "Pass the solution of the same batch of QPs, or its `active`.",
        )
    return active


def _checked_keep(qp: QuadraticProgram, fixed: Tensor, keep: int | None) -> int:
    n_f = fixed.shape[-1]
    if keep is None:
        return n_f
    if not isinstance(keep, Integral) or not n_f <= int(keep) <= qp.n_z:
        raise QPError.expected("keep", repr(keep), f"n_f = {n_f} <= keep <= n_z = {qp.n_z}")
    return int(keep)


# OpenMP's threads do not survive a fork: in the child torch, too, would wait for them for ever.
os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


def _solve_now(
    H: Tensor,
    q: Tensor,
    c: Tensor,
    C: Tensor,
    b: Tensor,
    G: Tensor,
    lb: Tensor,
    ub: Tensor,
    w: Tensor,
    fixed: Tensor,
    start: Tensor | None,
    keep: int,
    solver: str,
    on_failure: str,
) -> Outputs:
    raw, batch = _solve_flat(H, q, c, C, b, G, lb, ub, w, fixed, start, keep, solver, on_failure)
    outputs: Any = tuple(raw.all_tensors())
    if len(batch) == 1 and q.dtype == raw.value.dtype and q.device == raw.value.device:
        return outputs

    def out(tensor: Tensor) -> Tensor:
        dtype = q.dtype if tensor.is_floating_point() else tensor.dtype
        return tensor.reshape((*batch, *tensor.shape[1:])).to(q.device, dtype)

    return tuple(map(out, outputs))  # pyright: ignore[reportReturnType] - nine of them


def _solve_flat(*arguments: Any) -> tuple[RawSolution, torch.Size]:
    """Solve in float64, whatever comes in, on the CPU, or for "torch" on CUDA where q is.

    Failures are dealt with here. Returns the batch shape too.
    """
    *theta, start, keep, solver, on_failure = arguments
    q = theta[1]
    backend(solver)
    if on_failure not in ON_FAILURE:
        raise QPError.expected("on_failure", repr(on_failure), f"one of {', '.join(ON_FAILURE)}")
    device = q.device if solver == "torch" and q.is_cuda else CPU
    try:
        programs, batch = FlatPrograms.of(*theta, device=device)
        if start is not None:
            start = listed(start.to(device).expand(*batch, -1))
        raw = solve_programs(programs, keep, solver, start)
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        shapes = (x.shape[: x.ndim - n] for x, n in zip(theta, EVENT_NDIMS, strict=False))
        got = f"{broadcast(*shapes).numel():,} QPs of n_z = {q.shape[-1]}"
        remedy = f"Solve it in chunks, as of torch.split. The allocation said: {error}."
        raise QPError.expected("batch", got, "as many as memory has room for", remedy) from error
    if on_failure != "mask":
        _report(raw, batch, on_failure)
    return raw, batch


def _is_out_of_memory(error: Exception) -> bool:
    """True for a failed allocation, which torch's CPU allocator names only in its message."""
    kinds = (MemoryError, torch.OutOfMemoryError)
    return isinstance(error, kinds) or "DefaultCPUAllocator" in str(error)


solve_op = torch.library.custom_op("torch_qpmpc::solve", _solve_now, mutates_args=())


def _solve_opaque(*arguments: Any) -> Outputs:
    """`solve_op`, or where nothing looks on that needs an operator, what it does: sooner."""
    theta = arguments[:N_THETA]
    must_hide = is_traced(theta) or any(x.is_meta for x in theta)
    return (solve_op if must_hide else _solve_now)(*arguments)


def _report(raw: RawSolution, batch: torch.Size, on_failure: str) -> None:
    if raw.all_accepted or not raw.status.any():  # SOLVED is zero
        return
    failed = raw.status.nonzero().squeeze(-1)
    reasons = []
    for status in Status:
        where = (raw.status == status).nonzero().squeeze(-1)
        if status != Status.SOLVED and len(where):
            first = torch.unravel_index(where[0], batch) if batch else ()
            at = f", first at batch index {tuple(int(i) for i in first)}" if batch else ""
            reasons.append(f"{len(where)} {status.name}{at}: {status.explanation}")
    message = f"{len(failed)} of {len(raw.status)} QPs have no certified solution. " + ". ".join(
        reasons
    )
    if on_failure == "raise":
        if (raw.status[failed] == Status.INVALID_DATA).all():
            raise QPError(message)
        raise SolverError(message)
    warnings.warn(message, RuntimeWarning, stacklevel=2)


@solve_op.register_fake
def _(H, q, c, C, b, G, lb, ub, w, fixed, start, keep, solver, on_failure):
    operands = (H, q, c, C, b, G, lb, ub, w, fixed)
    batch = broadcast(*(t.shape[: t.ndim - n] for t, n in zip(operands, EVENT_NDIMS, strict=False)))

    def count() -> Tensor:
        return q.new_empty(batch, dtype=torch.int64)

    n_z, n_c, n_g, n_f = q.shape[-1], b.shape[-1], lb.shape[-1], fixed.shape[-1]
    vectors = [q.new_empty((*batch, n)) for n in (n_z, n_g, n_c, n_g, n_f)]
    return (q.new_empty(batch), *vectors, count(), q.new_empty(batch), count())


@solve_op.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return solve_op(*align(in_dims, args, EVENT_NDIMS)), (0,) * 9


def _setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
    _, z, sigma, chi, lam, xi, status, *_ = output
    ctx.set_materialize_grads(False)
    ctx.keep = inputs[KEEP]
    ctx.save_for_backward(*inputs[:N_THETA], z, sigma, chi, lam, xi, status)


def _backward(ctx: Any, grad_value: Tensor | None, *_: Any) -> tuple:
    if grad_value is None:
        return (None,) * (N_THETA + N_OTHERS)
    saved = ctx.saved_tensors
    theta, solution, needed = saved[:N_THETA], saved[N_THETA:], ctx.needs_input_grad[:N_THETA]
    given = (grad_value, *solution)
    small = _is_for_kernels(Sizes.of(theta[:-1]), theta[0], theta[-1])
    if small and not is_differentiating() and not is_traced(given):
        found = _gradients_by_kernel(needed, *per_sample.arrays(*given))
    else:
        found = _gradients(needed, theta, ctx.keep, *given)
    return (*found, *(None,) * N_OTHERS)


def _gradients_by_kernel(needed: Sequence[bool], *given: np.ndarray) -> Iterator[Tensor | None]:
    """`_gradients` of one theta, without derivatives of their own."""
    of_H, _, _, of_C, _, of_G, *_ = needed
    pairs = zip(per_sample.envelope(*given, of_H, of_C, of_G), needed, strict=True)
    return (torch.from_numpy(gradient) if need else None for gradient, need in pairs)


def _gradients(
    needed: Sequence[bool],
    theta: Sequence[Tensor],
    keep: int,
    grad_value: Tensor,
    z: Tensor,
    sigma: Tensor,
    chi: Tensor,
    lam: Tensor,
    xi: Tensor,
    status: Tensor,
) -> Iterator[Tensor | None]:
    """The envelope gradient in theta where it is ``needed``, from the solution."""
    if is_differentiating() and not torch.compiler.is_compiling():
        z, sigma, chi, lam, xi = _tied(keep, theta, z, chi, lam, xi, status)
    # An unsolved element has zeros here, but zero times an infinite incoming gradient is NaN.
    weight = torch.where(status.eq(int(Status.SOLVED)), grad_value, 0)
    gradients = envelope_gradients(weight, z, sigma, chi, lam, xi).values()
    return (f(x) if need else None for f, x, need in zip(gradients, theta, needed, strict=True))


def _tied(
    keep: int,
    theta: Sequence[Tensor],
    z: Tensor,
    chi: Tensor,
    lam: Tensor,
    xi: Tensor,
    status: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """z, sigma, chi, lam, xi as second derivatives need them: dependent on the data."""
    z, lam, chi, xi = differentiable(z, lam, chi, xi, status, *theta, keep)
    return z, slacks(z, *theta[5:9]), chi, lam, xi


def envelope_gradients(
    weight: Tensor, z: Tensor, sigma: Tensor, chi: Tensor, lam: Tensor, xi: Tensor
) -> dict[str, Callable[[Tensor], Tensor]]:
    """The gradient of sum_i weight_i value_i in each tensor of the QP, and in the fixed entries.

    Each is a function of the tensor: over the batch dimensions that it lacks, the gradient is
    summed.
    """
    weighted_z, negative = weight.unsqueeze(-1) * z, -weight
    return {
        "H": lambda like: 0.5 * outer(weighted_z, z, like),
        "q": lambda like: weighted_sum(weight, z, like),
        "c": lambda like: sum_to(weight, like),
        "C": lambda like: outer(chi, weighted_z, like),
        "b": lambda like: weighted_sum(negative, chi, like),
        "G": lambda like: outer(lam, weighted_z, like),
        "lb": lambda like: weighted_sum(negative, lam.clamp(max=0), like),
        "ub": lambda like: weighted_sum(negative, lam.clamp(min=0), like),
        "w": lambda like: weighted_sum(weight, sigma, like),
        "fixed": lambda like: weighted_sum(negative, xi, like),
    }


solve_op.register_autograd(_backward, setup_context=_setup_context)


class QPValue(torch.autograd.Function):
    """`solve_op` with the envelope gradient of its first output, the optimal value (eq:gradq)."""

    # Dynamo counts the parameters to tell this style of Function: no *args here.
    @staticmethod
    @signed
    def forward(H, q, c, C, b, G, lb, ub, w, fixed, start, keep, solver, on_failure) -> Outputs:
        return _solve_opaque(H, q, c, C, b, G, lb, ub, w, fixed, start, keep, solver, on_failure)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
        ctx.mark_non_differentiable(*output[1:])
        _setup_context(ctx, inputs, output)

    backward = staticmethod(_backward)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return QPValue.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 9


class Envelope(torch.autograd.Function):
    """The value of a solution that is known, with its gradient (eq:gradq): for `_solve_plain`."""

    @staticmethod
    def forward(ctx: Any, raw: RawSolution, keep: int, *theta: Tensor) -> Tensor:
        ctx.set_materialize_grads(False)
        ctx.raw, ctx.keep = raw, keep
        ctx.save_for_backward(*theta)
        # Not the solution's own tensor, which would keep itself alive by way of its gradient.
        return torch.from_numpy(raw.arrays.value)

    @staticmethod
    def backward(ctx: Any, grad_value: Tensor | None) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        if grad_value is None:
            return (None,) * (2 + N_THETA)
        theta, needed, x = ctx.saved_tensors, ctx.needs_input_grad[2:], ctx.raw
        if is_differentiating() or is_traced((grad_value,)):
            given = (grad_value, x.z, x.sigma, x.chi, x.lam, x.xi, x.status)
            return None, None, *_gradients(needed, theta, ctx.keep, *given)
        (incoming,), x = per_sample.arrays(grad_value), x.arrays
        given = (incoming, x.z, x.sigma, x.chi, x.lam, x.xi, x.status)
        return None, None, *_gradients_by_kernel(needed, *given)


class QPTangent(QPValue):
    """And in forward mode, which Dynamo does not trace."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Outputs) -> None:
        QPValue.setup_context(ctx, inputs, output)
        ctx.save_for_forward(*ctx.to_save)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple:
        *theta, z, _, chi, lam, xi, status = ctx.saved_tensors
        z, sigma, chi, lam, xi = _tied(ctx.keep, theta, z, chi, lam, xi, status)
        tangent = value_tangent(tangents[:N_THETA], z, sigma, chi, lam, xi)
        return torch.where(status.eq(int(Status.SOLVED)), tangent, 0), *(None,) * 8

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return QPTangent.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 9
