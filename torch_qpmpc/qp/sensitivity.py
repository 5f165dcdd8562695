"""The gradient of the solution itself: of z, and so of pi(s), and of the multipliers.

Within one active set the solution is affine in the data. With A the rows held at a bound, the
multipliers of saturated rows held at plus or minus w, and E z = (x_0, u_0), an incoming gradient is
carried back by the KKT system

    [H   C'  G_A' E'] [p]   [dl/dz    ]
    [C   0   0    0 ] [r] = [dl/dchi  ]
    [G_A 0   0    0 ] [t]   [dl/dlam_A]
    [E   0   0    0 ] [u]   [dl/dxi   ]

    dl/dH = -p z'               dl/dq = -p                dl/dC = -(chi p' + r z')    dl/db = r
    dl/dG = -(lam p' + t z')    dl/d(lb, ub)_A = t        dl/d(fixed) = u
    dl/dw_i = sign(lam_i) (dl/dlam_i - G_i p) where saturated

solved in condensed form for the whole batch at once. Where a row is weakly active (at its bound
with a zero multiplier) the solution has a kink, and this is one of its one-sided derivatives.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.batching import align, broadcast, flatten, outer, sum_to
from torch_qpmpc.qp.pipeline.batch import FlatPrograms
from torch_qpmpc.qp.pipeline.condensing import condensed_for
from torch_qpmpc.qp.pipeline.scaling import units_of
from torch_qpmpc.qp.program import Status, active_rows
from torch_qpmpc.qp.tangents import right_side, times
from torch_qpmpc.qp.tracing import is_hidden

_functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue] - has no stub

#: Residual of the KKT system from which on it counts as singular.
SINGULAR = 1e-8
#: Event dimensions of the operator's tensors: four gradients; z, lam, status; the QP's data.
_ADJOINT_NDIMS = (1, 1, 1, 1, 1, 1, 0, 2, 1, 0, 2, 1, 2, 1, 1, 1, 1)
#: Those of `SolutionGradient`: z, lam, chi, xi, status; the QP's data.
_SOLUTION_NDIMS = (1, 1, 1, 1, 0, 2, 1, 0, 2, 1, 2, 1, 1, 1, 1)


@torch.library.custom_op("torch_qpmpc::kkt_adjoint", mutates_args=())
def kkt_adjoint(
    grad_z: Tensor,
    grad_lam: Tensor,
    grad_chi: Tensor,
    grad_xi: Tensor,
    z: Tensor,
    lam: Tensor,
    status: Tensor,
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
    keep: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """p ``(*batch, n_z)``, r ``(*batch, n_c)``, t ``(*batch, n_g)``, u ``(*batch, n_f)``."""
    # Under vmap the gradients may have batch dimensions that the QP does not.
    vectors = (grad_z, grad_lam, grad_chi, grad_xi, z, lam, fixed)
    batch = broadcast(*(x.shape[:-1] for x in vectors), status.shape)
    fixed = fixed.expand(*batch, fixed.shape[-1])
    programs, batch = FlatPrograms.of(H, q, c, C, b, G, lb, ub, w, fixed)
    solved = (status == Status.SOLVED).cpu().expand(batch).reshape(-1, 1)

    def flat(tensor: Tensor) -> Tensor:
        return torch.where(solved, flatten(tensor, batch), 0)

    if not solved.all():
        programs = programs.without_nan()
    condensed = condensed_for(programs, keep)
    pull_z, pull_lam = flat(grad_z), flat(grad_lam)
    units, multipliers, weight = units_of(programs), flat(lam), programs.w
    if units is not None:  # of what size a multiplier is not zero
        multipliers, weight = (units.multipliers(programs, x) for x in (multipliers, weight))
    active, _ = active_rows(multipliers, weight)
    n_f = fixed.shape[-1]
    T_f, T = condensed.T[:, :, :n_f], condensed.T[:, :, n_f:]
    # What C p = dl/dchi and E p = dl/dxi fix; then the condensed system for the rest.
    particular = -programs.multiply(condensed.Y_neg, flat(grad_chi))
    particular = particular + programs.multiply(T_f, flat(grad_xi))
    right_v = programs.multiply(T.mT, pull_z - programs.multiply(programs.H, particular))
    right_t = (pull_lam - programs.multiply(programs.G, particular)) * active
    v, t = _solve(
        condensed.H[programs.group, n_f:, n_f:],
        condensed.G[programs.group, :, n_f:] * active.unsqueeze(-1),
        active,
        right_v,
        right_t,
    )
    p = particular + programs.multiply(T, v)
    left = pull_z - programs.multiply(programs.H, p) - programs.multiply(programs.G.mT, t)
    r = -programs.multiply(condensed.Y_neg.mT, left)
    u = (left - programs.multiply(programs.C.mT, r))[:, :n_f]
    return tuple(x.reshape(*batch, x.shape[-1]).to(z) for x in (p, r, t, u))  # pyright: ignore[reportReturnType] - four of them


def _solve(
    H: Tensor, G: Tensor, active: Tensor, right_v: Tensor, right_t: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve ``H v + G't = right_v, G v = right_t``; G and right_t are zero in rows not active."""
    d = H.shape[-1]
    rows = active.any(dim=0).nonzero().squeeze(-1)
    G, idle = G[:, rows], (~active[:, rows]).to(H.dtype)
    top = torch.cat((H, G.mT), dim=-1)
    kkt = torch.cat((top, torch.cat((G, torch.diag_embed(idle)), dim=-1)), dim=-2)
    right = torch.cat((right_v, right_t[:, rows]), dim=-1).unsqueeze(-1)
    solution = torch.linalg.solve_ex(kkt, right)[0]
    error = (kkt @ solution - right).abs().amax(dim=(-2, -1)) if kkt.numel() else right.new_zeros(0)
    bound = SINGULAR * (1 + right.abs().amax(dim=(-2, -1))) if kkt.numel() else error
    singular = ~(error <= bound)
    if singular.any():
        # Dependent active rows, or directions without curvature: the solution of least norm.
        inverse = torch.linalg.pinv(kkt[singular], hermitian=True)
        solution[singular] = inverse @ right[singular]
    t = torch.zeros_like(right_t)
    t[:, rows] = solution[:, d:, 0]
    return solution[:, :d, 0], t


@kkt_adjoint.register_fake
def _(grad_z, grad_lam, grad_chi, grad_xi, z, lam, status, *theta):
    return tuple(torch.empty_like(x) for x in (grad_z, grad_chi, grad_lam, grad_xi))


@kkt_adjoint.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return kkt_adjoint(*align(in_dims, args, _ADJOINT_NDIMS)), (0,) * 4


class KKTAdjoint(torch.autograd.Function):
    """`kkt_adjoint`, which a further derivative of the solution would have to pass."""

    @staticmethod
    def forward(*args):
        return kkt_adjoint(*args)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple:
        raise QPError.expected(
            "derivative",
            "a second one of the solution, or a third one of the value",
            "one of the solution, or two of the value",
            "Detach what need not be differentiated.",
        )

    @staticmethod
    def jvp(ctx: Any, *_: Tensor) -> tuple:
        return KKTAdjoint.backward(ctx)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return KKTAdjoint.apply(*align(in_dims, args, _ADJOINT_NDIMS)), (0,) * 4


def _adjoint(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    # Dynamo traces no Function that has a jvp.
    compiling = torch.compiler.is_compiling()
    return (kkt_adjoint if compiling else KKTAdjoint.apply)(*arguments)


@torch.library.custom_op("torch_qpmpc::solution", mutates_args=())
def solution_op(
    z: Tensor,
    lam: Tensor,
    chi: Tensor,
    xi: Tensor,
    status: Tensor,
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
    keep: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """z, lam, chi, xi as they are, tied to the data that they depend on."""
    return z.clone(), lam.clone(), chi.clone(), xi.clone()


@solution_op.register_fake
def _(z, lam, chi, xi, status, *theta):
    return tuple(torch.empty_like(part) for part in (z, lam, chi, xi))


@solution_op.register_vmap
def _(info: Any, in_dims: tuple, *args: Any) -> tuple:
    return solution_op(*align(in_dims, args, _SOLUTION_NDIMS)), (0,) * 4


def _setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
    *tensors, ctx.keep = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, *gradients: Tensor) -> tuple:
    grad_z, grad_lam, grad_chi, grad_xi = gradients
    z, lam, chi, _, status, *theta = ctx.saved_tensors
    H, q, _, C, b, G, lb, ub, w, fixed = theta
    p, r, t, u = _adjoint(grad_z, grad_lam, grad_chi, grad_xi, z, lam, status, *theta, ctx.keep)
    _, saturated = active_rows(lam, w)
    slope = torch.where(saturated, lam.sign() * (grad_lam - times(G, p)), 0)
    needed = ctx.needs_input_grad[5:15]
    of_theta = (
        lambda: -0.5 * (outer(p, z, H) + outer(z, p, H)),
        lambda: sum_to(-p, q),
        lambda: None,
        lambda: -(outer(chi, p, C) + outer(r, z, C)),
        lambda: sum_to(r, b),
        lambda: -(outer(lam, p, G) + outer(t, z, G)),
        lambda: sum_to(torch.where(lam < 0, t, 0), lb),
        lambda: sum_to(torch.where(lam > 0, t, 0), ub),
        lambda: sum_to(slope, w),
        lambda: sum_to(u, fixed),
    )
    found = (f() if need else None for f, need in zip(of_theta, needed, strict=True))
    return None, None, None, None, None, *found, None


solution_op.register_autograd(_backward, setup_context=_setup_context)


def signed(forward: Callable[..., Any]) -> Any:
    """A Function's ``forward`` that knows its own signature.

    ``apply`` asks for it at each call; to work it out takes as long as solving some ten QPs, and
    to bind all of its arguments to their names as long as a few.
    """
    parameters = [*inspect.signature(forward).parameters.values()]
    forward.__signature__ = _Positional(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    return forward


class _Positional(inspect.Signature):
    """Of what is called with all of its arguments by position."""

    def bind(self, *arguments: Any) -> Any:
        return SimpleNamespace(args=arguments, kwargs={}, apply_defaults=lambda: None)


class SolutionGradient(torch.autograd.Function):
    """`solution_op`, differentiable under `torch.func` too."""

    @staticmethod
    @signed
    def forward(z, lam, chi, xi, status, H, q, c, C, b, G, lb, ub, w, fixed, keep):
        return z.clone(), lam.clone(), chi.clone(), xi.clone()

    setup_context = staticmethod(_setup_context)
    backward = staticmethod(_backward)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return SolutionGradient.apply(*align(in_dims, args, _SOLUTION_NDIMS)), (0,) * 4


class SolutionTangent(SolutionGradient):
    """And in forward mode, which Dynamo does not trace."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        _setup_context(ctx, inputs, output)
        ctx.save_for_forward(*inputs[:-1])

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        z, lam, chi, xi, status, *theta = ctx.saved_tensors
        G, w = theta[5], theta[8]
        *right, saturated = right_side(tangents[5:15], z, lam, chi, xi, G, w)
        dz, dchi, dlam, dxi = _adjoint(*right, z, lam, status, *theta, ctx.keep)
        return dz, dlam + saturated, dchi, dxi

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple:
        return SolutionTangent.apply(*align(in_dims, args, _SOLUTION_NDIMS)), (0,) * 4


def differentiable(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """z, lam, chi, xi, tied to the data that they depend on: the arguments of `solution_op`."""
    return traceable(SolutionTangent, SolutionGradient, solution_op)(*arguments)


def is_differentiating() -> bool:
    """Whether a derivative of what is computed now may be asked for, in either mode."""
    # `torch.no_grad` is silent on the forward mode.
    return torch.is_grad_enabled() or forward_ad._current_level >= 0


def traceable(eager: Any, compiled: Any, operator: Any) -> Any:
    """Of three forms of a differentiable function, the one that PyTorch can trace now.

    Dynamo traces no Function that has a jvp, none at all under `vmap`, and no custom operator under
    `grad`. Of nested transforms it would drop the outer derivative without a word.
    """
    transforms = _transforms()
    if not torch.compiler.is_compiling():
        if not transforms and forward_ad._current_level < 0:
            return compiled.apply  # to get ready for forward mode takes time
        if transforms.count("Jvp") > 1:
            raise QPError.expected(
                "derivative", "jvp in jvp", "one forward mode", "Use hessian, or jacrev inside."
            )
        return eager.apply
    if set(transforms) <= {"Vmap"}:
        return operator if transforms else compiled.apply
    if transforms != ("Grad",):
        raise QPError.expected(
            "torch.compile",
            f"{' in '.join(reversed(transforms))}, transforms inside of what is compiled",
            "vmap, or one grad, jacrev or vjp of a scalar",
            "Leave this function out: torch.compiler.disable.",
        )

    def apply(*arguments: Any) -> Any:
        # Dynamo takes the gradient in a tensor for zero, or fails, if it is what `grad`
        # differentiates in and nothing was done to it before.
        own = (x.view_as(x) if isinstance(x, Tensor) else x for x in arguments)
        return compiled.apply(*own)

    return apply


def is_plain(tensors: Sequence[Tensor]) -> bool:
    """Whether nothing looks on at what is done with the tensors, but for reverse mode."""
    return forward_ad._current_level < 0 and not is_traced(tensors)


def is_traced(tensors: Sequence[Tensor]) -> bool:
    """Whether a trace, a transform or another class of tensor may be at work.

    The solvers must be hidden from these.
    """
    return is_hidden(tensors) or torch._C._len_torch_function_stack() > 0  # a default device


@torch.compiler.assume_constant_result
def _transforms() -> tuple[str, ...]:
    """The `torch.func` transforms that we are in, from the outermost."""
    stack = _functorch.get_interpreter_stack() or ()
    return tuple(interpreter.key().name for interpreter in stack)
