"""The state around a call: traces, transforms, forward mode, tensor classes, autocast, forks.

The solver must be hidden from traces and transforms, which torch has no public way to detect. A
test of each function fails if torch changes the internals that it reads.
"""

import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

_functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue] - has no stub

#: The tensor classes without a dispatch of their own.
PLAIN = frozenset((Tensor, nn.Parameter))
#: The dispatch key of `torch.autograd.grad` with ``is_grads_batched``.
BATCHED_GRADIENTS = torch._C._dispatch_key_parse("VmapMode")


def has_values(*tensors: Tensor) -> bool:
    """True if Python may branch on the values: no trace, transform or tensor class hides them."""
    core = torch._C
    return not (
        torch.compiler.is_compiling()
        or core._len_torch_dispatch_stack() > 0  # fake tensors, `make_fx`
        or core._get_tracing_state() is not None  # `torch.jit.trace`
        or core._dispatch_tls_is_dispatch_key_included(BATCHED_GRADIENTS)
        or _functorch.peek_interpreter_stack() is not None  # `torch.func`
        or not PLAIN.issuperset(map(type, tensors))  # tensors that fake or wrap others
        or any(x.is_meta for x in tensors)
    )


def is_eager(tensors: Sequence[Tensor]) -> bool:
    """True if operations run when called, and only reverse mode records them."""
    return (
        not is_forward_mode()
        and has_values(*tensors)
        and torch._C._len_torch_function_stack() == 0  # a default device, or a user's mode
    )


def is_forward_mode() -> bool:
    """True inside `torch.autograd.forward_ad.dual_level` or `torch.func.jvp`."""
    return forward_ad._current_level >= 0  # -1 outside of every level


def is_differentiating() -> bool:
    """True if the result may be differentiated, in either mode."""
    return torch.is_grad_enabled() or is_forward_mode()  # `torch.no_grad` leaves forward mode on


def transforms() -> tuple[str, ...]:
    """Return the `torch.func` transforms in effect, such as "Grad", from the outermost."""
    stack = _functorch.get_interpreter_stack() or ()
    return tuple(interpreter.key().name for interpreter in stack)


# As `torch.compiler.assume_constant_result` does, which imports the compiler: that takes a second.
vars(transforms)["_dynamo_marked_constant"] = True


def full_precision(like: Tensor) -> AbstractContextManager[object]:
    """Return a context without autocast on the device of ``like``."""
    device = like.device.type
    if device == "meta" or not torch.is_autocast_enabled(device):
        return nullcontext()
    return torch.autocast(device, enabled=False)


# OpenMP's threads do not exist in a forked child, and torch would wait for them.
os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))
