"""What a state_dict says of the module that it belongs to, so that no other one loads it."""

from __future__ import annotations

import json
import zlib
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError


def written(identity: dict[str, Any]) -> Tensor:
    """JSON in bytes: a tensor, as code that walks through a state_dict expects."""
    return torch.tensor(list(json.dumps(identity).encode()), dtype=torch.uint8, device="cpu")


def digest(mask: Tensor) -> str:
    """Name a mask by its count and a checksum."""
    entries = mask.cpu().flatten()
    return f"{int(entries.sum())} of {len(entries)} ({zlib.crc32(bytes(entries.tolist())):08x})"


def check_identity(found: Any, own: dict[str, Any]) -> None:
    """Raise `QPError`, by name, where a state_dict is that of another module."""
    if isinstance(found, Tensor) and found.is_meta:
        return
    try:
        # Rounded: the state_dict may have been converted, or be an average of several.
        theirs = json.loads(bytes(found.double().round().long().tolist()).decode())
        theirs.get("")
    except (AttributeError, TypeError, ValueError) as error:
        got = f"an _extra_state that cannot be read ({type(error).__name__})"
        remedy = "Leave the entry out: then nothing says whose state it is."
        raise QPError.expected("state_dict", got, "what a QPMPC wrote", remedy) from error
    for name, value in own.items():
        if theirs.get(name) != value:
            got = f"a state_dict with {name} = {theirs.get(name)!r}"
            remedy = "Load it into a QPMPC that was made with the same arguments."
            raise QPError.expected("state_dict", got, f"this module's {value!r}", remedy)
