"""Checks of the arguments and inputs of `QPMPC`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torch_qpmpc.checks import (
    check_choice,
    check_flag,
    check_number,
    check_seed,
    check_tensor,
    check_whole,
)
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.mpc.projections import check_step
from torch_qpmpc.qp.batching import broadcast, to_dtype
from torch_qpmpc.qp.pipeline.solve import ON_FAILURE

HESSIANS = ("diagonal", "block", "full")
#: In order, from the least tied to the most.
STRUCTURES = ("free", "varying", "tied")
#: The parts of theta by family; the paper advises a different learning rate for each.
COST = ("H", "H_f", "q", "c", "w")
CONSTRAINTS = ("C", "b", "G", "lb", "ub")


def check_structure(
    n_x: int,
    n_u: int,
    horizon: int,
    past: int,
    n_d: int,
    gamma: float,
    hessian: str,
    structure: str,
    learn: Collection[str],
    step: str,
    on_failure: str,
    discount_slack: bool,
    seed: int,
    **_: Any,
) -> None:
    """Raise `QPError` unless the sizes and choices among the arguments of `QPMPC` are valid."""
    for name, size in (("n_x", n_x), ("n_u", n_u), ("horizon", horizon), ("past", past)):
        if not isinstance(size, Integral) or isinstance(size, bool) or int(size) < 1:
            raise QPError.expected(name, repr(size), "a positive integer")
    check_whole("n_d", n_d, 0)
    check_number("gamma", gamma, lambda x: 0 < x <= 1, "a discount factor in (0, 1]")
    check_choice("hessian", hessian, HESSIANS)
    check_choice("structure", structure, STRUCTURES)
    check_choice("on_failure", on_failure, ON_FAILURE)
    check_step(step)
    check_flag("discount_slack", discount_slack)
    check_seed(seed)
    parts = (*COST, *CONSTRAINTS)
    if (
        not isinstance(learn, Collection)
        or isinstance(learn, str)
        or not all(isinstance(part, str) and part in parts for part in learn)
    ):
        raise QPError.expected(
            "learn", repr(learn), f"a collection of names among {', '.join(parts)}"
        )
    if hessian == "full" and "H_f" in learn:
        raise QPError.expected(
            "learn",
            "'H_f' with hessian='full'",
            "'H' alone",
            "A full H contains the terminal block.",
        )


def own(value: Any) -> Any:
    """Copy an argument that its caller may change: arrays, tensors, and containers of them."""
    if isinstance(value, Tensor):
        return value.detach().clone()
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, Mapping):
        return {key: own(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(own, value))
    return value


def learned_entries(learn: Collection[str], theta: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the masks in ``learn`` by part, True where an entry is learned."""
    if not isinstance(learn, Mapping):
        return {}
    masks = {}
    for part, mask in learn.items():
        if isinstance(mask, bool | np.bool_) and mask:
            continue
        name, shape = f"learn[{part!r}]", tuple(theta[part].shape)
        want = f"True, or a mask of bools of shape {shape}"
        try:
            mask = torch.as_tensor(mask)
        except (TypeError, ValueError, RuntimeError) as error:
            raise QPError.expected(name, repr(mask), want) from error
        if mask.dtype != torch.bool or tuple(mask.shape) != shape:
            got = f"{mask.dtype} of shape {tuple(mask.shape)}"
            raise QPError.expected(name, got, want, "True marks the entries to be learned.")
        masks[part] = mask.detach().cpu().clone()
    return masks


def check_model(A: Any, B: Any) -> tuple[Tensor, Tensor]:
    """Return A and B as tensors with at least two dimensions, which give n_x, n_u and past."""
    A, B = as_tensor("A", A), as_tensor("B", B)
    if A.ndim < 2 or B.ndim < 2:
        got = f"shapes {tuple(A.shape)} and {tuple(B.shape)}"
        raise QPError.expected("A, B", got, "matrices (n_x, n_x) and (n_x, n_u)")
    return A, B


def as_tensor(name: str, value: Any) -> Tensor:
    """Convert to a float64 tensor on the CPU; raise `QPError` unless it is finite."""
    tensor = _read(name, value)
    if not tensor.isfinite().all():
        raise QPError.expected(name, "NaN or inf", "finite entries")
    return tensor


def _read(name: str, value: Any) -> Tensor:
    of_scipy = hasattr(value, "toarray")
    if of_scipy or (isinstance(value, Tensor) and value.layout != torch.strided):
        remedy = f"Convert it: {name}.{'toarray' if of_scipy else 'to_dense'}()."
        kind = type(value).__name__ if of_scipy else f"a {value.layout} tensor"
        raise QPError.expected(name, f"{kind}, which is sparse", "a dense matrix", remedy)
    try:
        of_tensor = isinstance(value, Tensor) and (value.is_complex() or value.is_meta)
        if of_tensor or (isinstance(value, np.ndarray) and np.iscomplexobj(value)):
            raise TypeError
        # On the CPU: a default device of "meta" would drop the values of lists.
        return torch.as_tensor(value, dtype=torch.float64, device="cpu")
    except (TypeError, ValueError, RuntimeError) as error:
        raise QPError.expected(
            name, _brief(value), "a tensor, or what torch.as_tensor takes, of real numbers"
        ) from error


def _brief(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"a tensor of {value.dtype} on {value.device}"
    return repr(value)


def bound(name: str, bounds: tuple[Any, Any] | None, side: int, size: int) -> Tensor:
    """Return the lower bounds ``(size,)`` for side 0, or the upper ones for side 1."""
    if bounds is None:
        return torch.full((size,), (2 * side - 1) * torch.inf)
    try:
        lower, upper = bounds
    except (TypeError, ValueError) as error:
        raise QPError.expected(name, repr(bounds), "the pair (lower, upper)") from error
    values = _read(name, (lower, upper)[side])
    if values.isnan().any():
        raise QPError.expected(name, "NaN", "no NaN; inf for no bound")
    if tuple(values.shape) != (size,):
        raise QPError.expected(
            name, f"shape {tuple(values.shape)}", f"shape ({size},) on each side"
        )
    if (values == (1 - 2 * side) * torch.inf).any():
        raise QPError.expected(
            name, f"{values.tolist()}", ("lower bounds below inf", "upper bounds above -inf")[side]
        )
    return values


def bound_pair(name: str, bounds: tuple[Any, Any] | None, size: int) -> tuple[Tensor, Tensor]:
    """Return both sides of `bound`; raise `QPError` if they cross."""
    lower, upper = bound(name, bounds, 0, size), bound(name, bounds, 1, size)
    crossing = (lower > upper).nonzero()
    if len(crossing):
        i = int(crossing[0])
        got = f"lower {lower[i]:g} > upper {upper[i]:g} at entry {i}"
        raise QPError.expected(name, got, "lower <= upper", "The pair is (lower, upper).")
    return lower, upper


def cost_weights(
    stage_weight: Any, terminal_weight: Any, hessian: str, layout: Layout
) -> dict[str, Tensor]:
    """Return the initial H and H_f in the shapes for ``hessian``; only H if it is full.

    A dense weight of (x_k, u_k) alone has zeros for the preview.
    """
    stage = as_tensor("stage_weight", stage_weight)
    terminal = as_tensor("terminal_weight", terminal_weight)
    n_x, n, n_d, horizon = layout.n_x, layout.n, layout.n_d, layout.horizon
    diagonal = hessian == "diagonal"
    # A square matrix is one dense block, even where the horizon happens to be its size.
    diagonals = ((n,), (horizon, n)) if horizon != n else ((n,),)
    if not diagonal and tuple(stage.shape) in diagonals:
        stage = torch.diag_embed(stage)
    if not diagonal and tuple(terminal.shape) == (n_x,):
        terminal = torch.diag(terminal)
    if not diagonal and n_d:
        widened = (n_d, 0, n_d, 0)
        stage = F.pad(stage, widened) if stage.shape[-2:] == (n, n) else stage
        terminal = F.pad(terminal, widened) if terminal.shape == (n_x, n_x) else terminal
    event = (n,) if diagonal else (n_d + n,) * 2
    terminal_event = (n_x,) if diagonal else (n_d + n_x,) * 2
    per_stage = (horizon, *event)
    if tuple(stage.shape) not in (event, per_stage):
        got = f"shape {tuple(stage.shape)}"
        raise QPError.expected("stage_weight", got, f"shape {event} or {per_stage}")
    if tuple(terminal.shape) != terminal_event:
        got = f"shape {tuple(terminal.shape)}"
        raise QPError.expected("terminal_weight", got, f"shape {terminal_event}")
    check_weight("stage_weight", stage, diagonal, n_d)
    check_weight("terminal_weight", terminal, diagonal, n_d)
    if hessian == "full":
        return {"H": layout.block_hessian(stage, terminal)}
    return {"H": stage, "H_f": terminal}


def check_weight(name: str, weight: Tensor, diagonal: bool, n_d: int) -> None:
    """Raise `QPError` unless a weight, or its diagonal, is symmetric positive semidefinite.

    The block of the first n_d entries and its cross block may be any.
    """
    if not diagonal and not torch.allclose(weight, weight.mT):
        asymmetry = (weight - weight.mT).abs().max()
        raise QPError.expected(
            name, f"asymmetry {asymmetry:.3g}", "a symmetric matrix", "Pass (W + W.mT) / 2."
        )
    eigenvalues = weight if diagonal else torch.linalg.eigvalsh(weight[..., n_d:, n_d:])
    if (eigenvalues < (0.0 if diagonal else -1e-9 * eigenvalues.abs().max())).any():
        got = f"smallest eigenvalue {eigenvalues.min():.3g}"
        remedy = "It weights a cost: negate a reward's weight."
        raise QPError.expected(name, got, "a positive semidefinite weight", remedy)


def slack_weight(name: str, weight: Any, size: int | None = None) -> Tensor:
    """Return slack weights ``(size,)`` from one for all rows, or from one for each."""
    one, each = "a non-negative weight, or inf for hard rows", f"; or one for each of the {size}"
    expected = one if size is None else one + each
    if isinstance(weight, Real) or size is None:
        check_number(name, weight, lambda x: x >= 0, expected)
        return torch.full((size or 1,), float(weight), dtype=torch.float64)
    if isinstance(weight, Sequence | np.ndarray | Tensor) and not isinstance(weight, str):
        weights = _read(name, weight)
        if tuple(weights.shape) == (size,) and (weights >= 0).all():
            return weights
    raise QPError.expected(name, repr(weight), expected)


def check_pair(s: Tensor, a: Tensor, n_p: int, n_u: int, device: torch.device) -> Tensor:
    """Return s and a side by side, ``(*batch, n_p + n_u)``, in the dtype of s."""
    check_tensor("s", s, n_p, device=device)
    check_tensor("a", a, n_u, device=device)
    try:
        batch = broadcast(s.shape[:-1], a.shape[:-1])
    except RuntimeError as error:
        got = f"shape {tuple(a.shape)}"
        want = f"leading dimensions that broadcast with those of s, {tuple(s.shape[:-1])}"
        raise QPError.expected("a", got, want) from error
    if not s.shape[:-1] == a.shape[:-1] == batch:
        s, a = s.expand(*batch, -1), a.expand(*batch, -1)
    return torch.cat((s, to_dtype(a, s.dtype)), dim=-1)
