"""The parts of theta in the module that owns them, behind the parametrizations that they keep.

A learned part is a parameter, or is computed from parameters, its leaves: H from a factor, a C
that is tied from A and B. The others are buffers.
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
    """Make ``value`` a part: a parameter if it is learned, else a buffer."""
    if learned:
        module.register_parameter(name, nn.Parameter(value))
    else:
        module.register_buffer(name, value)


def keep(module: nn.Module, name: str, kept: list[nn.Module]) -> None:
    """Put a parameter behind ``kept``, the last of which the optimiser moves."""
    value = getattr(module, name).detach()
    for parametrization in kept:
        parametrize.register_parametrization(module, name, parametrization)
    if len(kept) > 1:  # each but the first has changed the value
        setattr(module, name, value)


def replace(module: nn.Module, name: str, kept: list[nn.Module]) -> None:
    """Put a part behind other parametrizations; its value stays, and whether it is frozen."""
    value = getattr(module, name).detach()
    # A deep copy has the same class, which remove_parametrizations would change.
    own = type(type(module).__name__, type(module).__bases__, {**vars(type(module))})
    module.__class__ = own  # pyright: ignore[reportAttributeAccessIssue] - the same but by id
    frozen = not any(leaf.requires_grad for leaf in leaves(module, name))
    parametrize.remove_parametrizations(module, name)
    delattr(module, name)
    register(module, name, value.clone(), True)
    keep(module, name, kept)
    for leaf in leaves(module, name):
        leaf.requires_grad_(not frozen)


def leaves(module: nn.Module, name: str) -> list[nn.Parameter]:
    """The parameters that the optimiser moves for a learned part: behind H its factor."""
    if not parametrize.is_parametrized(module, name):
        return [module.get_parameter(name)]
    return list(module.get_submodule(f"parametrizations.{name}").parameters(recurse=False))


def matrix(module: nn.Module, name: str) -> tuple[nn.Parameter | None, Tensor | None]:
    """The parameter whose entries are a part's own, and the mask of those that are learned.

    The parameter is None where the part is computed from others, or is not learned; the mask is
    None where all entries are learned.
    """
    if not parametrize.is_parametrized(module, name):
        return module._parameters.get(name), None
    found = list(module.get_submodule(f"parametrizations.{name}").children())
    if len(found) == 1 and isinstance(found[0], Masked):
        return leaves(module, name)[0], found[0].mask
    return None, None


def readable(module: nn.Module, learned: Collection[str]) -> dict[str, Tensor]:
    """The learned parts, detached: what stages share, once; A, B and D for C and G."""
    found = {}
    for part in learned:
        value = getattr(module, part).detach()
        kept = None
        if parametrize.is_parametrized(module, part):
            kept = next(iter(module.get_submodule(f"parametrizations.{part}").children()))
        if isinstance(kept, Banded | LinearRows):
            names = ("A", "B") if part == "C" else ("D", "D_f")
            found |= zip(names, kept.right_inverse(value), strict=True)
        else:
            found[part] = value[kept.first] if isinstance(kept, Tied) else value
    return found


def groups(
    module: nn.Module, learned: Collection[str], rates: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Parameter groups for an optimiser, one for each learned part."""
    if not isinstance(rates, Mapping):
        got = type(rates).__name__
        raise QPError.expected("rates", got, "a mapping such as {'cost': .., 'constraints': ..}")
    known = {*COST, *CONSTRAINTS, "cost", "constraints"}
    if unknown := set(rates) - known:
        raise QPError.expected("rates", sorted(unknown), f"names among {sorted(known)}")
    if unused := set(rates) - {*learned, "cost", "constraints"}:
        expected = f"parts that are learned: {', '.join(learned) or 'none'}"
        raise QPError.expected("rates", sorted(unused), expected, "Name them in learn, too.")
    found = []
    for part in learned:
        rate = rates.get(part, rates.get("cost" if part in COST else "constraints"))
        if rate is None:
            raise QPError.expected(
                "rates", f"nothing for {part}", "a rate for every learned part, or its family"
            )
        check_number(f"rates[{part}]", rate, lambda x: 0 <= x < math.inf, "a finite number >= 0")
        found.append({"params": leaves(module, part), "lr": rate, "name": part})
    return found
