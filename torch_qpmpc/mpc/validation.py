"""Checks of the arguments and inputs of `QPMPC`."""

from collections.abc import Callable, Collection, Mapping
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_tensor, ungraded
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout
from torch_qpmpc.qp.program import broadcast

P = ParamSpec("P")
T = TypeVar("T")
#: Largest asymmetry of a weight's entry, relative to its row and column.
ASYMMETRY = 1e-5
STRUCTURES = ("free", "tied")
#: The parts of theta by family; the paper advises a different learning rate for each.
COST = ("H", "H_f", "q", "c", "w")
CONSTRAINTS = ("C", "b", "G", "lb", "ub")


def check_learn(learn: Collection[str], structure: str, layout: Layout) -> None:
    """Raise `QPError` unless ``learn`` has names of parts that a QPMPC can learn."""
    parts = (*COST, *CONSTRAINTS)
    several = isinstance(learn, Collection) and not isinstance(learn, str)
    if not several or not all(isinstance(part, str) and part in parts for part in learn):
        expected = f"a collection of names among {', '.join(parts)}"
        raise QPError.expected("learn", repr(learn), expected)
    if "G" in learn and structure != "free" and not layout.n_mixed + layout.n_terminal:
        remedy = "Pass constraints, or structure='free'."
        raise QPError.expected("learn", "'G' without constraints", "other parts", remedy)


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


def check_one_model(mpc: Any) -> None:
    """Raise `QPError` if a QPMPC has dynamics, so that its C and b depend on s."""
    if mpc.sequential is not None:
        want = "one with A and B, for one C"
        raise QPError.expected("mpc", "one with dynamics", want, "mpc.C is that of the origin.")


def check_dynamics(dynamics: Any, learn: Collection[str], levels: Any) -> None:
    """Raise `QPError` if dynamics are to have what needs A and B."""
    if dynamics is not None:
        if levels is not None:
            raise QPError.expected("action_levels", "levels beside dynamics", "none")
        for part in {"C", "b"} & {*learn}:
            got, want = f"{part!r} beside dynamics", "other parts: the dynamics take its place"
            raise QPError.expected("learn", got, want, "A module's parameters are learned.")


def check_no_levels(mpc: Any, what: str) -> None:
    """Raise `QPError` if a QPMPC has levels, for ``what`` needs one QP."""
    if mpc.levels is not None:
        got, want = "one with levels", f"one without, for {what}"
        remedy = "Without action_levels or u_levels there is the relaxed plan."
        raise QPError.expected("mpc", got, want, remedy)


def as_tensor(name: str, value: Any) -> Tensor:
    """Convert by `read_numbers`; raise `QPError` unless all entries are finite."""
    tensor = read_numbers(name, value)
    if not tensor.isfinite().all():
        raise QPError.expected(name, "NaN or inf", "finite entries")
    return tensor


def owned(name: str, value: Any) -> Tensor | None:
    """Return a copy by `as_tensor`, which the caller cannot change, or None for None."""
    return None if value is None else as_tensor(name, value).detach().clone()


def without_gradients(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function that refuses tensors that require grad, and runs without gradients."""
    parameters = signature(function)

    @wraps(function)
    def run(*args: P.args, **options: P.kwargs) -> T:
        for name, value in parameters.bind(*args, **options).arguments.items():
            ungraded(name, value)
        with torch.no_grad():
            return function(*args, **options)

    return run


def read_numbers(name: str, value: Any) -> Tensor:
    """Convert to a float64 tensor on the CPU, which may have NaN or inf."""
    value = ungraded(name, value)
    of_scipy = hasattr(value, "toarray")
    if of_scipy or (isinstance(value, Tensor) and value.layout != torch.strided):
        remedy = f"Convert it: {name}.{'toarray' if of_scipy else 'to_dense'}()."
        kind = type(value).__name__ if of_scipy else f"a {value.layout} tensor"
        raise QPError.expected(name, f"{kind}, which is sparse", "a dense matrix", remedy)
    try:
        of_tensor = isinstance(value, Tensor) and (value.is_complex() or value.is_meta)
        if of_tensor or (isinstance(value, np.ndarray) and np.iscomplexobj(value)):
            raise TypeError
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            value = np.array(value, dtype=float)  # torch warns of read-only, refuses foreign bytes
        # On the CPU: a default device of "meta" would drop the values of lists.
        return torch.as_tensor(value, dtype=torch.float64, device="cpu")
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        tensor = isinstance(value, Tensor)
        got = f"a tensor of {value.dtype} on {value.device}" if tensor else repr(value)
        want = "a tensor, or what torch.as_tensor takes, of real numbers"
        raise QPError.expected(name, got, want) from error


def check_weight(name: str, weight: Tensor, diagonal: bool, n_d: int) -> None:
    """Raise `QPError` unless a weight, or its diagonal, is symmetric positive semidefinite.

    An entry's asymmetry is relative to the largest of its row and of its column. The block of the
    first n_d entries and its cross block may be any.
    """
    if not diagonal and weight.numel():
        asymmetry, size = (weight - weight.mT).abs(), weight.abs().amax(-1).sqrt()
        size = torch.maximum(size, weight.mT.abs().amax(-1).sqrt())
        limit = ASYMMETRY * size.unsqueeze(-1) * size.unsqueeze(-2)
        if not (asymmetry <= limit).all():
            got = f"asymmetry {asymmetry.max():.3g}"
            raise QPError.expected(name, got, "a symmetric matrix", "Pass (W + W.mT) / 2.")
    eigenvalues = weight if diagonal else torch.linalg.eigvalsh(weight[..., n_d:, n_d:])
    tolerance = 0.0 if diagonal else 1e-5 if weight.dtype == torch.float32 else 1e-9
    if (eigenvalues < -tolerance * eigenvalues.abs().max()).any():
        got = f"smallest eigenvalue {eigenvalues.min():.3g}"
        remedy = "It weights a cost: negate a reward's weight."
        raise QPError.expected(name, got, "a positive semidefinite weight", remedy)


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
    return torch.cat((s, a.to(s.dtype)), dim=-1)
