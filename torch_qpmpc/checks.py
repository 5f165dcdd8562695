"""Checks of arguments at the public boundary.

They cover types, shapes and plain numbers; reading a tensor's values would slow down every call.
"""

from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError

#: What `check_number` accepts, and what it says.
Accepted = tuple[Callable[[Any], bool], str]
POSITIVE: Accepted = (lambda x: 0 < x < float("inf"), "a finite number > 0")
NONNEGATIVE: Accepted = (lambda x: 0 <= x < float("inf"), "a finite number >= 0")


def class_name(value: Any) -> str:
    """Return the name of a value's class, without torch's prefix if it has parametrizations."""
    return type(value).__name__.removeprefix("Parametrized")


def check_kind(name: str, value: Any, kind: type, remedy: str = "") -> None:
    """Raise `QPError` unless ``value`` is a ``kind``."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise QPError.expected(name, class_name(value), f"{article} {kind.__name__}", remedy)


def check_whole(name: str, value: Any, least: int) -> None:
    """Raise `QPError` unless ``value`` is an integer, NumPy's included, of at least ``least``."""
    if not isinstance(value, Integral) or isinstance(value, bool) or int(value) < least:
        raise QPError.expected(name, repr(value), f"a whole number >= {least}")


def check_seed(seed: Any) -> None:
    """Raise `QPError` unless ``seed`` is a whole number that torch's generators take."""
    if not isinstance(seed, Integral) or isinstance(seed, bool) or not 0 <= int(seed) < 2**63:
        raise QPError.expected("seed", repr(seed), "a whole number >= 0 and < 2^63")


def check_number(
    name: str, value: Any, accepts: Callable[[Any], bool], expected: str, remedy: str = ""
) -> None:
    """Raise `QPError` unless ``value`` is a number with ``accepts(value)``, False for NaN."""
    if not isinstance(value, Real) or isinstance(value, bool) or not accepts(value):
        raise QPError.expected(name, repr(value), expected, remedy)


def check_flag(name: str, value: Any) -> None:
    """Raise `QPError` unless ``value`` is a bool."""
    if not isinstance(value, bool):
        raise QPError.expected(name, repr(value), "True or False")


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise `QPError` unless ``value`` is one of ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise QPError.expected(name, repr(value), f"one of {', '.join(choices)}")


def check_tensor(
    name: str,
    value: Any,
    *event: int | str,
    batched: bool = True,
    device: torch.device | None = None,
    remedy: str = "",
) -> Tensor:
    """Return ``value`` if it is a floating-point tensor of the expected shape and device.

    ``event`` are its trailing dimensions; a string stands for any size. Leading dimensions need
    ``batched``. ``remedy`` ends the message of a wrong shape.
    """
    if not isinstance(value, Tensor) or not value.is_floating_point():
        got = value.dtype if isinstance(value, Tensor) else class_name(value)
        how = f"Convert it: torch.as_tensor({name}).float()."
        raise QPError.expected(name, got, "a floating-point torch.Tensor", how)
    lead = value.ndim - len(event)
    fits = lead == 0 or (batched and lead > 0)
    if fits and value.shape[lead:] != event:
        pairs = zip(event, value.shape[lead:], strict=True)
        fits = all(n == size for n, size in pairs if isinstance(n, int))
    if not fits:
        sizes = [*["*batch"] * batched, *map(str, event)]
        want = f"shape ({', '.join(sizes)}{',' * (len(sizes) == 1)})"
        raise QPError.expected(name, f"shape {tuple(value.shape)}", want, remedy)
    if device is not None and value.device != device:
        remedy = f"Move it, or the module: .to({str(value.device)!r})."
        raise QPError.expected(name, f"a tensor on {value.device}", f"one on {device}", remedy)
    return value


def ungraded(name: str, value: Any) -> Any:
    """Return ``value``; raise `QPError` if it is or has a tensor whose gradient would be lost."""
    parts = value.values() if isinstance(value, dict) else value
    parts = parts if isinstance(value, dict | list | tuple) else ()
    if isinstance(value, Tensor) and value.requires_grad and torch.is_grad_enabled():
        remedy = f"Pass {name}.detach(): no gradient flows through this argument."
        raise QPError.expected(name, "a tensor that requires grad", "one without", remedy)
    for part in parts:
        ungraded(name, part)
    return value
