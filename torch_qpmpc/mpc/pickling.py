"""How a `QPMPC` is pickled: by its constructor's arguments and its state.

A parametrised module refuses to be pickled, which would bar it from spawned collectors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import nn
from torch.nn.utils import parametrize

from torch_qpmpc.errors import QPError


def reduce(
    module: nn.Module, arguments: dict[str, Any], kept: Callable[[str], list[nn.Module]]
) -> tuple:
    """What ``__reduce_ex__`` returns; ``kept`` is what a part of ``module`` keeps by itself."""
    # TorchRL sends a policy to its workers on the meta device, without values to compare.
    real = not any(part.is_meta for part in module.buffers())
    for name in getattr(module, "parametrizations", ()) if real else ():
        found = module.get_submodule(f"parametrizations.{name}").children()
        if [type(part) for part in found] != [type(part) for part in kept(name)]:
            got = f"a parametrization of {name} that is not QPMPC's own"
            remedy = "Save the state_dict, or remove_parametrizations first."
            raise QPError.expected("pickle", got, "QPMPC's own", remedy)
    plain = parametrize.type_before_parametrizations(module)
    frozen = [name for name, part in module.named_parameters() if not part.requires_grad]
    # The arguments say whose state it is; a tensor made for that could not be shared with a child.
    state = {name: x for name, x in module.state_dict().items() if name != "_extra_state"}
    return _rebuild, (plain, arguments, state, frozen, module.training)


def _rebuild(
    cls: type[nn.Module], arguments: dict, state: dict, frozen: list[str], training: bool
) -> nn.Module:
    module = cls(**arguments)
    module.load_state_dict(state, assign=True)
    for name in frozen:
        module.get_parameter(name).requires_grad_(False)
    return module.train(training)
