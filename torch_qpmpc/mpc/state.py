"""Identity of a QPMPC in its state_dict, files and pickles.

The identity prevents loading a state into another module. torch does not pickle parametrised
modules, but spawned collectors need it: a pickle has the scheme and the state.
"""

import json
import zlib
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils import parametrize

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.parameters import chain
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


def identity(mpc: Any) -> dict[str, Any]:
    """Return what values depend on besides parameters and buffers."""
    own = mpc.levels
    arrays = (own.values, own.rows, own.rules, own.starts) if own else ()
    return {
        **asdict(mpc.layout),
        "blocks": [*mpc.layout.blocks] or None,  # None as in files from before blocks
        "gamma": float(mpc.gamma),
        **{name: getattr(mpc, name) for name in ("structure", "hessian", "step")},
        "discount_slack": mpc.scheme.bounds.discount_slack,
        "learn": {x: digest(mpc._masks[x]) if x in mpc._masks else True for x in mpc.learned},
        "hard rows": digest(mpc.scheme.theta["w"].isinf()),
        "action_levels": own and repr([*(x.tolist() for x in arrays), int(own.max_nodes)]),
        "dynamics": None if mpc.sequential is None else type(mpc.sequential.dynamics).__name__,
    }


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


def check_own(what: str, mpc: Any) -> None:
    """Raise `QPError` if a part of a QPMPC has other parametrizations than its own.

    ``what`` is to be written: a pickle or a file.
    """
    for name in getattr(mpc, "parametrizations", ()):
        own = mpc._parametrizations_for(name, getattr(mpc, name).detach())
        if [*map(type, chain(mpc, name))] != [*map(type, own)]:
            got = f"a parametrization of {name} that is not QPMPC's own"
            remedy = "Save the state_dict, or remove_parametrizations first."
            raise QPError.expected(what, got, "QPMPC's own", remedy)


def stored(mpc: Any) -> dict[str, Any]:
    """Return the content of a file that `QPMPC.load` reads."""
    return {"arguments": mpc.arguments, "mpc": mpc.state_dict()}


def reduce(mpc: Any) -> tuple:
    """Return the value of ``__reduce_ex__``."""
    # TorchRL sends a policy to its workers on the meta device, without values to compare.
    if not any(part.is_meta for part in mpc.buffers()):
        check_own("pickle", mpc)
    plain = parametrize.type_before_parametrizations(mpc)
    frozen = [name for name, part in mpc.named_parameters() if not part.requires_grad]
    # The parameters themselves, which an optimiser in the same pickle has, too. The scheme
    # identifies the state; a child process cannot share the tensor of _extra_state.
    state = {x: y for x, y in mpc.state_dict(keep_vars=True).items() if x != "_extra_state"}
    return _rebuild, (plain, mpc.scheme, mpc._options(), state, frozen, mpc.training)


def _rebuild(cls: Any, scheme: Scheme, options: Any, state: Any, frozen: Any, mode: bool) -> Any:
    module = cls(scheme, **options)
    module.load_state_dict(state, assign=True)
    for name in frozen:
        module.get_parameter(name).requires_grad_(False)
    return module.train(mode)
