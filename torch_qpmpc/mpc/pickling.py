"""Saving of a `QPMPC` by its constructor's arguments and its state.

torch does not pickle parametrised modules, but spawned collectors need it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torch_qpmpc.errors import QPError


def reduce(
    module: nn.Module, arguments: dict[str, Any], expected: Callable[[str], list[nn.Module]]
) -> tuple:
    """Return the value of ``__reduce_ex__``; ``expected`` gives a part's own parametrizations."""
    # TorchRL sends a policy to its workers on the meta device, without values to compare.
    real = not any(part.is_meta for part in module.buffers())
    for name in getattr(module, "parametrizations", ()) if real else ():
        attached = module.get_submodule(f"parametrizations.{name}").children()
        if [type(x) for x in attached] != [type(x) for x in expected(name)]:
            got = f"a parametrization of {name} that is not QPMPC's own"
            remedy = "Save the state_dict, or remove_parametrizations first."
            raise QPError.expected("pickle", got, "QPMPC's own", remedy)
    plain = parametrize.type_before_parametrizations(module)
    frozen = [name for name, part in module.named_parameters() if not part.requires_grad]
    # The arguments identify the state; a child process cannot share the tensor of _extra_state.
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


def plain(value: Any) -> Any:
    """Convert an argument to tensors and plain values, which ``weights_only=True`` reads."""
    if value is None or isinstance(value, bool | Tensor):
        return value
    if isinstance(value, str):
        return str(value)
    if isinstance(value, Real):  # numpy's, too
        return int(value) if isinstance(value, Integral) else float(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return type(value)(map(plain, value)) if type(value) is list else tuple(map(plain, value))
    return torch.as_tensor(value)
