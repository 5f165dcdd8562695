"""What else may look at tensors while a program runs: traces, transforms, other tensor classes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

_functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue] - has no stub

#: The tensors that nothing but autograd looks at.
PLAIN = frozenset((Tensor, nn.Parameter))
#: On while `torch.autograd.grad` is asked for gradients with ``is_grads_batched``.
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
