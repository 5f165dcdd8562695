"""Every read of torch's internals: traces, transforms, forward mode, tensor classes.

The solver must be hidden from whatever records operations instead of running them, and torch has no
public way to find out. A test of each function fails if torch changes what it reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

_functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue] - has no stub

#: The classes of tensors that only autograd records.
PLAIN = frozenset((Tensor, nn.Parameter))
#: The dispatch key of `torch.autograd.grad` with ``is_grads_batched``.
BATCHED_GRADIENTS = torch._C._dispatch_key_parse("VmapMode")


def is_hidden(tensors: Sequence[Tensor]) -> bool:
    """True if a trace, a transform or a tensor class may keep the values from the program."""
    core = torch._C
    return (
        torch.compiler.is_compiling()
        or core._len_torch_dispatch_stack() > 0  # fake tensors, traces
        or core._get_tracing_state() is not None
        or core._dispatch_tls_is_dispatch_key_included(BATCHED_GRADIENTS)
        or _functorch.peek_interpreter_stack() is not None  # `torch.func`
        or not PLAIN.issuperset(map(type, tensors))
    )


def has_values(*tensors: Tensor) -> bool:
    """True if the program may branch on the tensors' values."""
    return not is_hidden(tensors) and not any(x.is_meta for x in tensors)


def is_eager(tensors: Sequence[Tensor]) -> bool:
    """True if operations run as they are called, and nothing but reverse mode records them."""
    return (
        not is_forward_mode()
        and has_values(*tensors)
        and torch._C._len_torch_function_stack() == 0  # a default device, or a user's mode
    )


def is_forward_mode() -> bool:
    """True inside `torch.autograd.forward_ad.dual_level` or `torch.func.jvp`."""
    return forward_ad._current_level >= 0


def is_differentiating() -> bool:
    """True if a derivative of what is computed now may follow, in either mode."""
    return torch.is_grad_enabled() or is_forward_mode()  # `torch.no_grad` leaves forward mode on


def transforms() -> tuple[str, ...]:
    """The `torch.func` transforms around the program, such as "Grad", from the outermost."""
    stack = _functorch.get_interpreter_stack() or ()
    return tuple(interpreter.key().name for interpreter in stack)


# As `torch.compiler.assume_constant_result` does, which imports the compiler: that takes a second.
vars(transforms)["_dynamo_marked_constant"] = True
