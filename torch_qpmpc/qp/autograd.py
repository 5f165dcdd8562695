"""The eager path: tensors become arrays once, and one autograd Function attaches the derivative.

Between the two everything works in float64 without autograd, once per batch.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.qp.batching import broadcast, flatten_batch
from torch_qpmpc.qp.derivatives import N_THETA, gradients
from torch_qpmpc.qp.forking import serial_if_forked
from torch_qpmpc.qp.pipeline.arrays import BatchSolution, to_tensor
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.solve import solve_programs
from torch_qpmpc.qp.program import NDIMS, Status
from torch_qpmpc.qp.solvers import backend

ON_FAILURE = ("raise", "warn", "mask")
#: The tensors of a `QPSolution`: value, z, chi, lam, xi, status, residual, value_error, iterations,
#: active.
Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def solve_eager(
    theta: Sequence[Tensor], start: Tensor | None, n_kept: int, solver: str, on_failure: str
) -> Outputs:
    """Solve; value, z, chi, lam and xi are differentiable in ``theta``, H to w and fixed."""
    outputs = solve_now(*theta, start, n_kept, solver, on_failure)  # pyright: ignore[reportCallIssue]
    if torch.is_grad_enabled() and any(x.requires_grad for x in theta):
        outputs = (*Solution.apply(outputs[:6], n_kept, *theta), *outputs[5:])
    return outputs


class Solution(torch.autograd.Function):
    """The derivatives of a computed solution in theta."""

    @staticmethod
    def forward(ctx: Any, known: Sequence[Tensor], n_kept: int, *theta: Tensor) -> tuple:
        *solution, status = known
        ctx.set_materialize_grads(False)
        ctx.n_kept = n_kept
        # Saving z, chi, lam and xi, which are outputs, makes this backward differentiable.
        ctx.save_for_backward(*theta, *solution[1:], status)
        return tuple(solution)

    @staticmethod
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        theta, solution = ctx.saved_tensors[:N_THETA], ctx.saved_tensors[N_THETA:]
        needed = ctx.needs_input_grad[2:]
        return None, None, *gradients(incoming, theta, solution, needed, ctx.n_kept)


def solve_now(
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
    n_kept: int,
    solver: str,
    on_failure: str,
) -> Outputs:
    """Solve a batch, on the CPU or, with ``solver="torch"``, on the device of q.

    Args:
        H, q, c, C, b, G, lb, ub, w: see `QuadraticProgram`.
        fixed, solver, on_failure: see `torch_qpmpc.solve_qp`.
        start: active sets ``(*batch, n_g)`` of a warm start.
        n_kept: see `Programs.of`.

    Raises:
        QPError: the solver or ``on_failure`` is unknown, the data are invalid, or the batch
            exceeds the memory.
        SolverError: with ``on_failure="raise"``, a QP has no certified solution.
    """
    backend(solver)
    if on_failure not in ON_FAILURE:
        raise QPError.expected("on_failure", repr(on_failure), f"one of {', '.join(ON_FAILURE)}")
    device = q.device if solver == "torch" and q.is_cuda else None
    theta = (H, q, c, C, b, G, lb, ub, w)
    try:
        with serial_if_forked():
            programs, batch = Programs.of(*theta, fixed, n_kept=n_kept, device=device)
            if start is not None:
                start = flatten_batch(start.detach().to(q.device).expand(*batch, -1)).contiguous()
            sets = start.numpy(force=True) if start is not None and device is None else start
            solution = solve_programs(programs, solver, sets)
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        shapes = (x.shape[: x.ndim - n] for x, n in zip(theta, NDIMS, strict=True))
        count = broadcast(*shapes, fixed.shape[:-1]).numel()
        got = f"{count:,} QPs of n_z = {q.shape[-1]}"
        remedy = f"Solve the batch in chunks, with torch.split. The allocation failed: {error}."
        raise QPError.expected("batch", got, "as many as fit in memory", remedy) from error
    if on_failure != "mask" and not solution.all_accepted:
        _report(solution, batch, on_failure)

    outputs: Any = tuple(map(to_tensor, solution))
    if len(batch) == 1 and q.dtype == torch.float64 and q.device == outputs[0].device:
        return outputs

    def out(x: Tensor) -> Tensor:
        dtype = q.dtype if x.is_floating_point() else x.dtype
        return x.reshape((*batch, *x.shape[1:])).to(q.device, dtype)

    return tuple(map(out, outputs))  # pyright: ignore[reportReturnType] - a tuple of ten


def _is_out_of_memory(error: Exception) -> bool:
    """True for a failed allocation, which torch's CPU allocator reports only in the message."""
    kinds = (MemoryError, torch.OutOfMemoryError)
    return isinstance(error, kinds) or "DefaultCPUAllocator" in str(error)


def _report(solution: BatchSolution, batch: torch.Size, on_failure: str) -> None:
    statuses = torch.as_tensor(solution.status).cpu()
    failed = statuses.nonzero().squeeze(-1)
    reasons = []
    for status in Status:
        where = (statuses == status).nonzero().squeeze(-1)
        if status != Status.SOLVED and len(where):
            first = torch.unravel_index(where[0], batch) if batch else ()
            at = f", first at batch index {tuple(int(i) for i in first)}" if batch else ""
            reasons.append(f"{len(where)} {status.name}{at}: {status.explanation}")
    message = f"{len(failed)} of {len(statuses)} QPs have no certified solution. " + ". ".join(
        reasons
    )
    if on_failure == "raise":
        if (statuses[failed] == Status.INVALID_DATA).all():
            raise QPError(message)
        raise SolverError(message)
    warnings.warn(message, RuntimeWarning, stacklevel=2)
