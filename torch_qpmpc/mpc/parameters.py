"""The parts of theta as parameters or buffers of a module, with their parametrizations.

A learned part is a parameter, or is computed from parameters, its leaves: H from a factor, a C
that is tied from A and B. The other parts are buffers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

from torch import Tensor, nn
from torch.nn.utils import parametrize

from torch_qpmpc.checks import check_number
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.parametrizations import Banded, LinearRows, Masked, Tied
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST


def register(module: nn.Module, name: str, value: Tensor, learned: bool) -> None:
    """Register a part: a parameter if it is learned, else a buffer."""
    if learned:
        module.register_parameter(name, nn.Parameter(value))
    else:
        module.register_buffer(name, value)


def attach(module: nn.Module, name: str, parametrizations: list[nn.Module]) -> None:
    """Attach parametrizations to a parameter; its value stays."""
    value = getattr(module, name).detach()
    for parametrization in parametrizations:
        parametrize.register_parametrization(module, name, parametrization)
    if len(parametrizations) > 1:  # each but the first has changed the value
        setattr(module, name, value)


def replace(module: nn.Module, name: str, parametrizations: list[nn.Module]) -> None:
    """Replace the parametrizations of a part; its value and its ``requires_grad`` stay."""
    value = getattr(module, name).detach()
    # torch makes a class per module, which its deep copies share; remove_parametrizations deletes
    # the part's property from it, and would break the copies.
    own = type(type(module).__name__, type(module).__bases__, {**vars(type(module))})
    module.__class__ = own  # pyright: ignore[reportAttributeAccessIssue] - equal but for its identity
    frozen = not any(leaf.requires_grad for leaf in leaves(module, name))
    parametrize.remove_parametrizations(module, name)
    delattr(module, name)
    register(module, name, value.clone(), True)
    attach(module, name, parametrizations)
    for leaf in leaves(module, name):
        leaf.requires_grad_(not frozen)


def leaves(module: nn.Module, name: str) -> list[nn.Parameter]:
    """Return the parameters of a learned part, such as the factor of H."""
    if not parametrize.is_parametrized(module, name):
        return [module.get_parameter(name)]
    return list(module.get_submodule(f"parametrizations.{name}").parameters(recurse=False))


def matrix(module: nn.Module, name: str) -> tuple[nn.Parameter | None, Tensor | None]:
    """Return the parameter with the entries of a part, and the mask of those that are learned.

    The parameter is None if the part is computed from others, or is not learned; the mask is None
    if all entries are learned.
    """
    if not parametrize.is_parametrized(module, name):
        return module._parameters.get(name), None
    own = list(module.get_submodule(f"parametrizations.{name}").children())
    if len(own) == 1 and isinstance(own[0], Masked):
        return leaves(module, name)[0], own[0].mask
    return None, None


def readable(module: nn.Module, learned: Collection[str]) -> dict[str, Tensor]:
    """Return the learned parts, detached: A, B, E and D for C and G, and shared values once."""
    values = {}
    for part in learned:
        value = getattr(module, part).detach()
        first = None
        if parametrize.is_parametrized(module, part):
            first = next(iter(module.get_submodule(f"parametrizations.{part}").children()))
        if isinstance(first, Banded | LinearRows):
            names = ("A", "B", "E") if part == "C" else ("D", "D_f")
            values |= dict(zip(names, first.right_inverse(value), strict=False))
        else:
            values[part] = value[first.first] if isinstance(first, Tied) else value
    return values


def groups(
    module: nn.Module, learned: Collection[str], rates: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Return parameter groups for an optimiser, one for each learned part."""
    if not isinstance(rates, Mapping):
        got = type(rates).__name__
        raise QPError.expected("rates", got, "a mapping such as {'cost': .., 'constraints': ..}")
    known = {*COST, *CONSTRAINTS, "cost", "constraints"}
    if unknown := set(rates) - known:
        raise QPError.expected("rates", sorted(unknown), f"names among {sorted(known)}")
    if unused := set(rates) - {*learned, "cost", "constraints"}:
        expected = f"parts that are learned: {', '.join(learned) or 'none'}"
        raise QPError.expected("rates", sorted(unused), expected, "Add them to learn.")
    result = []
    for part in learned:
        rate = rates.get(part, rates.get("cost" if part in COST else "constraints"))
        if rate is None:
            raise QPError.expected(
                "rates", f"nothing for {part}", "a rate for every learned part, or its family"
            )
        check_number(f"rates[{part}]", rate, lambda x: 0 <= x < math.inf, "a finite number >= 0")
        result.append({"params": leaves(module, part), "lr": rate, "name": part})
    return result
