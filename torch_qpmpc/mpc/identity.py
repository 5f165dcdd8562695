"""The identity in a state_dict, which prevents loading it into another module."""

from __future__ import annotations

import json
import zlib
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError


def encoded(identity: dict[str, Any]) -> Tensor:
    """Return JSON bytes as a tensor, which code that traverses a state_dict expects."""
    return torch.tensor(list(json.dumps(identity).encode()), dtype=torch.uint8, device="cpu")


def digest(mask: Tensor) -> str:
    """Return the count and a checksum of a mask."""
    entries = mask.cpu().flatten()
    return f"{int(entries.sum())} of {len(entries)} ({zlib.crc32(bytes(entries.tolist())):08x})"


def check_identity(state: Any, own: dict[str, Any]) -> None:
    """Raise `QPError` if the identity of a state_dict differs from the module's own."""
    if isinstance(state, Tensor) and state.is_meta:
        return
    try:
        # Rounded: the state_dict may have been converted, or be an average of several.
        theirs = json.loads(bytes(state.double().round().long().tolist()).decode())
        theirs.get("")
    except (AttributeError, TypeError, ValueError) as error:
        got = f"an _extra_state that cannot be read ({type(error).__name__})"
        remedy = "Remove the entry to load the state without this check."
        raise QPError.expected("state_dict", got, "one that QPMPC wrote", remedy) from error
    for name, value in own.items():
        if theirs.get(name) != value:
            got = f"a state_dict with {name} = {theirs.get(name)!r}"
            remedy = "Load it into a QPMPC with the same arguments."
            raise QPError.expected("state_dict", got, f"this module's {value!r}", remedy)
