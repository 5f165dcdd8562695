"""Identity of a QPMPC in its state_dict, files and pickles.

The identity prevents loading a state into another module. torch does not pickle parametrised
modules, but spawned collectors need it: a pickle has the scheme and the state.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.scheme import Scheme

#: The kind of file that `QPMPC.save` writes.
KIND = "QPMPC"


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


def check_own(what: str, module: nn.Module, expected: Callable[[str], list[nn.Module]]) -> None:
    """Raise `QPError` if a part has other parametrizations than those ``expected``.

    ``what`` is to be written: a pickle or a file.
    """
    for name in getattr(module, "parametrizations", ()):
        attached = module.get_submodule(f"parametrizations.{name}").children()
        if [type(x) for x in attached] != [type(x) for x in expected(name)]:
            got = f"a parametrization of {name} that is not QPMPC's own"
            remedy = "Save the state_dict, or remove_parametrizations first."
            raise QPError.expected(what, got, "QPMPC's own", remedy)


def stored(module: Any) -> dict[str, Any]:
    """Return the content of a file from which `QPMPC.load` makes the QPMPC ``module``."""
    return {"arguments": module.arguments, "mpc": module.state_dict()}


def reduce(
    module: nn.Module,
    scheme: Scheme,
    options: dict[str, Any],
    expected: Callable[[str], list[nn.Module]],
) -> tuple:
    """Return the value of ``__reduce_ex__``; ``expected`` gives a part's own parametrizations."""
    # TorchRL sends a policy to its workers on the meta device, without values to compare.
    if not any(part.is_meta for part in module.buffers()):
        check_own("pickle", module, expected)
    plain = parametrize.type_before_parametrizations(module)
    frozen = [name for name, part in module.named_parameters() if not part.requires_grad]
    # The scheme identifies the state; a child process cannot share the tensor of _extra_state.
    state = {name: x for name, x in module.state_dict().items() if name != "_extra_state"}
    return _rebuild, (plain, scheme, options, state, frozen, module.training)


def _rebuild(
    cls: type[nn.Module],
    scheme: Scheme,
    options: dict[str, Any],
    state: dict[str, Tensor],
    frozen: list[str],
    training: bool,
) -> nn.Module:
    module = cls(scheme, **options)
    module.load_state_dict(state, assign=True)
    for name in frozen:
        module.get_parameter(name).requires_grad_(False)
    return module.train(training)
