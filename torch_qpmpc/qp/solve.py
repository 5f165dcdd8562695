"""`solve_qp`: the certified, differentiable solution of a batch of QPs."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind
from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.autograd import solve_eager, solve_traced
from torch_qpmpc.qp.batching import broadcast
from torch_qpmpc.qp.program import QuadraticProgram
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.tracing import is_eager


def solve_qp(
    qp: QuadraticProgram,
    fixed: Tensor | None = None,
    *,
    solver: str = "proxqp",
    on_failure: str = "raise",
    warm_start: QPSolution | Tensor | None = None,
) -> QPSolution:
    """Solve a batch of QPs (eq:qp2, eq:qp3); every solution is certified.

    Args:
        qp: the QPs.
        fixed: values of the first n_f entries of z, ``(*batch, n_f)``: s for V, (s, a) for Q.
        solver: ``"proxqp"``, ``"daqp"``, ``"torch"`` or ``"qpsolvers:NAME"``. QPs that the
            certificate rejects are solved again by the others.
        on_failure: the treatment of unsolved elements. ``"raise"`` raises `SolverError`; ``"warn"``
            and ``"mask"`` give them ``value = inf`` and no gradient, with and without a warning.
        warm_start: a solution of nearly equal QPs, or its ``active`` ``(*batch, n_g)``, tried
            before the solver. It saves time, and changes the result only within the tolerance.

    Returns:
        The solution, differentiable in every tensor of ``qp`` and in ``fixed``: ``value`` by the
        envelope theorem, and twice; the rest by the KKT system (`torch_qpmpc.qp.derivatives`).

    Raises:
        QPError: an argument is invalid, or (with ``on_failure="raise"``) elements are unsolved only
            because of invalid data.
        SolverError: with ``on_failure="raise"``, an element is infeasible, unbounded or not solved.

    References:
        Büskens and Maurer (2001), as cited at eq:gradq.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> qp = qm.QPMPC.of(1, 1, 3, A=[[1.0]], B=[[1.0]], hessian="full").quadratic_program()
        >>> s = torch.ones(1, dtype=torch.float64, requires_grad=True)
        >>> solution = qm.solve_qp(qp, s, solver="daqp")
        >>> solution.value.backward()
        >>> torch.allclose(s.grad, -solution.xi)  # eq:gradq
        True
    """
    check_kind("qp", qp, QuadraticProgram, "Pass mpc.quadratic_program(), or call mpc.solve(s).")
    for name, choice in (("solver", solver), ("on_failure", on_failure)):
        if not isinstance(choice, str):
            raise QPError.expected(name, repr(choice), "a name")
    if fixed is None:
        fixed = qp.q.new_zeros(0)
    return solve(qp, fixed, None, solver, on_failure, warm_start)


def solve(
    qp: QuadraticProgram,
    fixed: Tensor,
    n_kept: int | None,
    solver: str,
    on_failure: str,
    warm_start: QPSolution | Tensor | None,
) -> QPSolution:
    """Solve as `solve_qp`, with ``n_kept`` leading entries of z kept when C z = b is eliminated.

    V and Q that keep the same entries share one elimination. None keeps the fixed entries.
    """
    batch = _checked_batch(qp, fixed)
    start = _checked_start(qp, batch, warm_start)
    theta = (*qp.tensors(), fixed)
    options = (fixed.shape[-1] if n_kept is None else n_kept, solver, on_failure)
    if is_eager(theta):
        return QPSolution(qp, *solve_eager(theta, start, *options))
    return QPSolution(qp, *solve_traced(*theta, start, *options))


def _checked_batch(qp: QuadraticProgram, fixed: Tensor) -> tuple[int, ...]:
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
        return broadcast(qp.batch_shape, fixed.shape[:-1])
    except RuntimeError as error:
        raise QPError.expected(
            "fixed",
            f"shape {tuple(fixed.shape)}",
            f"leading dimensions that broadcast with the QP's batch {tuple(qp.batch_shape)}",
        ) from error


def _checked_start(
    qp: QuadraticProgram, batch: tuple[int, ...], warm_start: QPSolution | Tensor | None
) -> Tensor | None:
    if warm_start is None:
        return None
    if not isinstance(warm_start, QPSolution | Tensor):
        got = type(warm_start).__name__
        raise QPError.expected("warm_start", got, "a QPSolution, or its `active`")
    active = warm_start if isinstance(warm_start, Tensor) else warm_start.active
    want = (*batch, qp.lb.shape[-1])
    if tuple(active.shape) != want or active.dtype is not torch.int8:
        raise QPError.expected(
            "warm_start",
            f"shape {tuple(active.shape)} of {active.dtype}",
            f"{want} of torch.int8",
            "Pass the solution of the same batch of QPs, or its `active`.",
        )
    return active
