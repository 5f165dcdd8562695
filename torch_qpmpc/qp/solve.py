"""`solve_qp`: the certified, differentiable solution of a batch of QPs.

*Eager* calls run the pipeline and attach one autograd Function. *Traced* calls (`torch.func`,
compile, fake tensors, forward mode) are one custom operator over the same pipeline, opaque to them,
and a Function around it that is differentiable under `torch.func` and in forward mode.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.batching import align, schema
from torch_qpmpc.qp.derivatives import N_THETA, gradients, tangents
from torch_qpmpc.qp.pipeline.solve import solve_now
from torch_qpmpc.qp.program import EVENT_SHAPES, NDIMS, QuadraticProgram, broadcast
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.tracing import is_differentiating, is_eager, is_forward_mode, transforms

#: Event dimensions of the operator's tensors: H, q, c, C, b, G, lb, ub, w, fixed, start.
EVENT_NDIMS = (*NDIMS, 1, 1)
#: The number of arguments after those: start, n_kept, solver, on_failure.
N_OTHERS = 4


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
        >>> mpc = qm.QPMPC.from_model([[1.0]], [[1.0]], 3, stage_weight=[1.0, 0.1])
        >>> qp = mpc.quadratic_program()
        >>> s = torch.ones(1, dtype=torch.float64, requires_grad=True)
        >>> solution = qm.solve_qp(qp, s, solver="daqp")
        >>> solution.value.backward()
        >>> torch.allclose(s.grad, -solution.xi)  # eq:gradq
        True
    """
    check_kind("qp", qp, QuadraticProgram, "Pass mpc.quadratic_program(), or call mpc.solve(s).")
    check_kind("solver", solver, str)
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
    check_tensor("fixed", fixed, "n_f", device=qp.q.device)
    if fixed.shape[-1] > qp.n_z:
        want = f"shape (*batch, n_f) with n_f <= n_z = {qp.n_z}"
        raise QPError.expected("fixed", f"shape {tuple(fixed.shape)}", want)
    theta = (*qp.tensors(), fixed)
    try:
        batch = broadcast(qp.batch_shape, fixed.shape[:-1])
    except RuntimeError as error:
        got, shape = f"shape {tuple(fixed.shape)}", tuple(qp.batch_shape)
        expected = f"leading dimensions that broadcast with the QP's batch {shape}"
        raise QPError.expected("fixed", got, expected) from error
    n_kept = fixed.shape[-1] if n_kept is None else n_kept
    run: Callable[..., tuple[Tensor, ...]] = solve_traced
    if is_eager(theta):
        learned = torch.is_grad_enabled() and any(x.requires_grad for x in theta)
        run = Eager.apply if learned else solve_now
    start = None if warm_start is None else _active(warm_start, (*batch, qp.lb.shape[-1]))
    return QPSolution(qp, *run(*theta, start, n_kept, solver, on_failure))


def _active(warm_start: QPSolution | Tensor, want: tuple[int, ...]) -> Tensor:
    """Return the active set of a warm start, of the shape that the QPs ``want``."""
    if not isinstance(warm_start, QPSolution | Tensor):
        got = type(warm_start).__name__
        raise QPError.expected("warm_start", got, "a QPSolution, or its `active`")
    active = warm_start if isinstance(warm_start, Tensor) else warm_start.active
    if tuple(active.shape) != want or active.dtype is not torch.int8:
        got, expected = f"shape {tuple(active.shape)} of {active.dtype}", f"{want} of torch.int8"
        remedy = "Pass the solution of the same batch of QPs, or its `active`."
        raise QPError.expected("warm_start", got, expected, remedy)
    return active


NAMES = (*EVENT_SHAPES, "fixed")
OTHERS = "Tensor? start, int n_kept, str solver, str on_failure"
solve_op = torch.library.custom_op(
    "torch_qpmpc::solve",
    solve_now,
    mutates_args=(),
    schema=schema(NAMES, OTHERS, 10),
)


def solve_traced(*arguments: Any) -> tuple[Tensor, ...]:
    """Call `solve_now` in the form that the current trace or transform supports.

    Dynamo traces no Function that has a jvp, no Function under `vmap`, and no custom operator under
    `grad`. It would silently drop the outer derivative of nested transforms.

    Raises:
        QPError: the combination of transforms is not supported.
    """
    if not is_differentiating():
        return solve_op(*arguments)
    stack = transforms()
    if not torch.compiler.is_compiling():
        if stack.count("Jvp") > 1:
            raise QPError.expected(
                "derivative", "jvp in jvp", "one forward mode", "Use hessian, or jacrev inside."
            )
        forward = stack or is_forward_mode()
        return (TracedForward if forward else Traced).apply(*arguments)
    if set(stack) <= {"Vmap"}:
        return solve_op(*arguments) if stack else Traced.apply(*arguments)
    if stack == ("Grad",):
        # Without an operation on an argument of `grad`, Dynamo fails or takes its gradient as zero.
        return Traced.apply(*(x.view_as(x) if isinstance(x, Tensor) else x for x in arguments))
    raise QPError.expected(
        "torch.compile",
        f"{' in '.join(reversed(stack))} inside a compiled function",
        "vmap, or one grad, jacrev or vjp of a scalar",
        "Exclude this function with torch.compiler.disable.",
    )


@solve_op.register_fake
def _(H, q, c, C, b, G, lb, ub, w, fixed, start, n_kept, solver, on_failure):
    operands = (H, q, c, C, b, G, lb, ub, w, fixed)
    batch = broadcast(*(t.shape[: t.ndim - n] for t, n in zip(operands, EVENT_NDIMS, strict=False)))

    def count() -> Tensor:
        return q.new_empty(batch, dtype=torch.int64)

    n_z, n_c, n_g, n_f = q.shape[-1], b.shape[-1], lb.shape[-1], fixed.shape[-1]
    vectors = [q.new_empty((*batch, n)) for n in (n_z, n_c, n_g, n_f)]
    active = q.new_empty((*batch, n_g), dtype=torch.int8)
    errors = q.new_empty(batch), q.new_empty(batch)
    return (q.new_empty(batch), *vectors, count(), *errors, count(), active)


@solve_op.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return solve_op(*align(in_dims, args, EVENT_NDIMS)), (0,) * 10


def _setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
    _, z, chi, lam, xi, status, *_ = output
    ctx.set_materialize_grads(False)
    ctx.n_kept = inputs[N_THETA + 1]
    # Saving z, chi, lam and xi, which are outputs, makes this backward differentiable.
    ctx.save_for_backward(*inputs[:N_THETA], z, chi, lam, xi, status)


def _backward(ctx: Any, *incoming: Tensor | None) -> tuple:
    # Read once: checkpointing forbids a second time, and other hooks repeat their work.
    saved, needed = ctx.saved_tensors, ctx.needs_input_grad[:N_THETA]
    grads = gradients(incoming[:5], saved[:N_THETA], saved[N_THETA:], needed, ctx.n_kept)
    return (*grads, *(None,) * N_OTHERS)


solve_op.register_autograd(_backward, setup_context=_setup_context)


class Traced(torch.autograd.Function):
    """`solve_op`, differentiable under `torch.func`."""

    # No *args: Dynamo recognises this style of Function by its number of parameters.
    @staticmethod
    def forward(
        H, q, c, C, b, G, lb, ub, w, fixed, start, n_kept, solver, on_failure
    ) -> tuple[Tensor, ...]:
        return solve_op(H, q, c, C, b, G, lb, ub, w, fixed, start, n_kept, solver, on_failure)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[5:])
        _setup_context(ctx, inputs, output)

    backward = staticmethod(_backward)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return Traced.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 10


class Eager(Traced):
    """`solve_now` itself, without the operator."""

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, ...]:
        return solve_now(*arguments)


class TracedForward(Traced):
    """`Traced`, differentiable in forward mode as well, which Dynamo does not trace."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        Traced.setup_context(ctx, inputs, output)
        ctx.save_for_forward(*ctx.to_save)

    @staticmethod
    def jvp(ctx: Any, *d_inputs: Tensor | None) -> tuple:
        saved = ctx.saved_tensors
        d_outputs = tangents(d_inputs[:N_THETA], saved[:N_THETA], saved[N_THETA:], ctx.n_kept)
        return *d_outputs, *(None,) * 5

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return TracedForward.apply(*align(in_dims, args, EVENT_NDIMS)), (0,) * 10
