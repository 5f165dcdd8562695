"""The parts of theta as parameters or buffers of a module, and their unconstrained coordinates.

A learned part is a parameter, or is computed from parameters, its leaves: H from a factor L of
H = L L', a tied C from A and B. These are its coordinates, to which any residual can be added: H
stays positive semidefinite, w non-negative and a tied C a model. Other parts are buffers, and
coordinates themselves.
"""

import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import starmap
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torch_qpmpc.checks import NONNEGATIVE, check_kind, check_number, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.parametrizations import SIGNED, Banded, LinearRows, Tied
from torch_qpmpc.mpc.validation import CONSTRAINTS, COST
from torch_qpmpc.qp.kernels.linalg import equal
from torch_qpmpc.qp.program import broadcast
from torch_qpmpc.qp.tracing import PLAIN

#: Parts with more entries are large.
LARGE = 2**14
#: The coordinates of a tied C and a tied G.
MODELS: dict[type, tuple[str, ...]] = {Banded: ("A", "B", "E"), LinearRows: ("D", "D_f")}


def chain(module: nn.Module, name: str) -> list[nn.Module]:
    """Return the parametrizations of a part, in order; none if it is plain."""
    if not parametrize.is_parametrized(module, name):
        return []
    return [*module.get_submodule(f"parametrizations.{name}").children()]


class Theta(nn.Module):
    """A module that holds the parts of theta, some of them ``learned``."""

    learned: tuple[str, ...]
    sequential: Any

    def _attach(self, name: str, value: Tensor, parametrizations: list[nn.Module]) -> None:
        """Register a learned part with its value and parametrizations."""
        self.register_parameter(name, nn.Parameter(value))
        for parametrization in parametrizations:
            parametrize.register_parametrization(self, name, parametrization)
        if len(parametrizations) > 1:  # each but the first has changed the value
            setattr(self, name, value)

    def _replace(self, name: str, parametrizations: list[nn.Module]) -> None:
        """Replace the parametrizations of a part; its value and its ``requires_grad`` stay."""
        value = getattr(self, name).detach().clone()
        # torch makes a class per module, which its deep copies share; remove_parametrizations
        # deletes the part's property from it, and would break the copies.
        own = type(type(self).__name__, type(self).__bases__, {**vars(type(self))})
        self.__class__ = own  # pyright: ignore[reportAttributeAccessIssue] - equal but for its identity
        frozen = not any(leaf.requires_grad for leaf in self.leaves(name))
        parametrize.remove_parametrizations(self, name)
        delattr(self, name)
        self._attach(name, value, parametrizations)
        for leaf in self.leaves(name):
            leaf.requires_grad_(not frozen)

    def leaves(self, part: str) -> list[nn.Parameter]:
        """Return the parameters of the learned ``part``, such as the factor of ``"H"``.

        Raises:
            QPError: ``part`` is not learned.
        """
        if part not in self.learned:
            expected = f"one of the learned parts: {', '.join(self.learned) or 'none'}"
            raise QPError.expected("part", repr(part), expected)
        if not parametrize.is_parametrized(self, part):
            return [self.get_parameter(part)]
        return list(self.get_submodule(f"parametrizations.{part}").parameters(recurse=False))

    def readable(self) -> dict[str, Tensor]:
        """Return the learned parts, detached: A, B, E and D for C and G, shared values once."""
        values = {}
        for part in self.learned:
            value = getattr(self, part).detach()
            first = next(iter(chain(self, part)), None)
            if isinstance(first, Banded | LinearRows):
                values |= dict(zip(MODELS[type(first)], first.right_inverse(value), strict=False))
            else:
                values[part] = value[first.first] if isinstance(first, Tied) else value
        return values

    def parameter_groups(self, rates: Mapping[str, float]) -> list[dict[str, Any]]:
        """Return parameter groups for an optimiser, one for each learned part of theta.

        Args:
            rates: learning rates by part (``"H"``, ..), for others by family, ``"cost"`` (H, H_f,
                q, c, w) and ``"constraints"`` (C, b, G, lb, ub), and of a module of ``"dynamics"``.

        Raises:
            QPError: a learned part has no rate, or a name or a rate is invalid.
        """
        check_kind("rates", rates, Mapping, "Map names: {'cost': .., 'constraints': ..}.")
        known = {*COST, *CONSTRAINTS, "cost", "constraints", "dynamics"}
        if unknown := set(rates) - known:
            raise QPError.expected("rates", sorted(unknown), f"names among {sorted(known)}")
        learned, dynamics = self.learned, [*getattr(self.sequential, "parameters", list)()]
        if unused := set(rates) - {*learned, "cost", "constraints", *["dynamics"] * bool(dynamics)}:
            expected = (
                f"parts that are learned: {', '.join(learned) or 'none'}, or a dynamics module"
            )
            raise QPError.expected("rates", sorted(unused), expected, "Add them to learn.")
        result = []
        for part in (*learned, *["dynamics"] * ("dynamics" in rates)):
            rate = rates.get(part, rates.get("cost" if part in COST else "constraints"))
            if rate is None:
                want = "a rate for every learned part, or its family"
                raise QPError.expected("rates", f"nothing for {part}", want)
            check_number(f"rates[{part}]", rate, *NONNEGATIVE)
            own = dynamics if part == "dynamics" else self.leaves(part)
            result.append({"params": own, "lr": rate, "name": part})
        return result

    def coordinates(self) -> dict[str, Tensor]:
        """Return the unconstrained coordinates of theta, which residuals move, by name.

        They are the parts themselves or, behind learned parts, factors of H, H_f and w, the shorter
        vectors of tied parts, and A, B, E and D, D_f of a tied C and G.
        """
        parts = (self._coordinates_of(part) for part in (*COST, *CONSTRAINTS))
        return {name: x for part in parts for name, x in part.items()}

    def _moved(self, residuals: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the parts of theta with ``residuals`` ``(*batch, ..)`` added to coordinates."""
        check_kind("residuals", residuals, Mapping, "Map names to tensors: {'q': ..}.")
        rest = dict(residuals)
        theta = {}
        for part in (*COST, *CONSTRAINTS):
            before = self._coordinates_of(part)
            own = {name: rest.pop(name) for name in before if name in rest}
            for name, residual in own.items():
                start = before[name]
                check_tensor(f"residuals[{name!r}]", residual, *start.shape, device=start.device)
            theta[part] = self._with_residuals(part, before, own) if own else getattr(self, part)
        check_names("residuals", rest, self)
        return theta

    def _coordinates_of(self, part: str) -> dict[str, Tensor]:
        """Return those of a part; H, H_f and w have some only if they are learned."""
        if part in ("C", "b") and self.sequential is not None:
            return {}  # the dynamics take their place
        if not parametrize.is_parametrized(self, part):
            learned = part in self._parameters
            return {} if part in SIGNED and not learned else {part: getattr(self, part)}
        own: Any = self.get_submodule(f"parametrizations.{part}")
        names = MODELS.get(type(next(iter(own.children()))), (part,))
        # By attribute, as a functional call replaces parameters with plain tensors.
        if hasattr(own, "original"):
            return {names[0]: own.original}
        originals = (getattr(own, f"original{i}", None) for i in range(len(names)))
        return {name: x for name, x in zip(names, originals, strict=True) if x is not None}

    def _with_residuals(
        self, part: str, before: dict[str, Tensor], residuals: dict[str, Tensor]
    ) -> Tensor:
        after = [
            x + residuals[name].to(x.dtype) if name in residuals else x
            for name, x in before.items()
        ]
        value, own = after[0], chain(self, part)
        if own and isinstance(own[0], Banded | LinearRows):
            value = for_each(own.pop(0), after, [x.ndim for x in before.values()])
        for parametrization in own:
            value = parametrization(value)
        return value


def check_names(argument: str, names: Collection[str], module: Theta) -> None:
    """Raise `QPError` if one of the ``names`` in an argument is not a coordinate's."""
    known = module.coordinates()
    if unknown := [name for name in names if name not in known]:
        unlearned = [name for name in unknown if name in SIGNED and hasattr(module, name)]
        remedy = f"Add {unlearned[0]} to learn." if unlearned else ""
        expected = f"names among {', '.join(known)}"
        raise QPError.expected(argument, ", ".join(map(repr, unknown)), expected, remedy)


class Leaves:
    """The modules and tensors that a QPMPC's theta follows from, and their content.

    Contents are compared, as versions do not show changes by ``.data``, NumPy or other processes,
    but not those of large parts that are not learned. They are ``known`` if all tensors are plain
    and none is a plain attribute, as in functional calls.
    """

    def __init__(self, module: Any) -> None:
        self._walked = _walked(module)
        tensors = [x for x in self._walked if isinstance(x, Tensor)]
        attributes = (vars(x).values() for x in self._walked if isinstance(x, nn.Module))
        plain = all(type(x) in PLAIN and x.is_cpu and x.is_contiguous() for x in tensors)
        plain = plain and not any(x.is_inference() for x in tensors)  # which have no version
        self.known = plain and not any(isinstance(x, Tensor) for part in attributes for x in part)
        rest = [x for name, x in module._buffers.items() if name not in module.learned]
        large = {id(x) for x in rest if x.numel() > LARGE}
        states = ((x, x.data_ptr(), x._version) for x in tensors if self.known)
        self._states, self._contents = [*states], []
        for x in tensors if self.known else ():
            if id(x) not in large:
                words = np.uint8 if x.nbytes % 8 else np.uint64
                own = x.detach().reshape(-1).numpy().view(words)
                self._contents.append((own, own.copy()))

    def unchanged(self, module: nn.Module) -> bool:
        """Return True if ``module`` has the same modules, tensors and content."""
        walked = _walked(module)
        same = self.known and len(walked) == len(self._walked)
        same = same and all(map(operator.is_, walked, self._walked))
        same = same and all(x.data_ptr() == at and x._version == n for x, at, n in self._states)
        return same and all(starmap(equal, self._contents))


def _walked(module: nn.Module) -> list[Any]:
    """Return a module, its tensors but C_0, which theta does not depend on, and its children's."""
    found: list[Any] = [module, *module._parameters.values()]
    found += [x for name, x in module._buffers.items() if name != "C_0"]
    for child in module._modules.values():
        if child is not None:
            found += _walked(child)
    return found


def for_each(
    function: Callable[..., Tensor], operands: Sequence[Tensor], ndims: Sequence[int]
) -> Tensor:
    """Call a function of unbatched tensors, of ``ndims`` dimensions, for each of their batch."""
    leads = [x.ndim - n for x, n in zip(operands, ndims, strict=True)]
    if not any(leads):
        return function(*operands)
    batches = [x.shape[:lead] for x, lead in zip(operands, leads, strict=True)]
    try:
        batch = broadcast(*batches)
    except RuntimeError as error:
        got = f"batch dimensions {', '.join(str(tuple(shape)) for shape in batches)}"
        raise QPError.expected("residuals", got, "ones that broadcast") from error
    if not batch.numel():
        zeros = (x.new_zeros(x.shape[lead:]) for x, lead in zip(operands, leads, strict=True))
        return operands[0].new_zeros(*batch, *function(*zeros).shape)
    flat = [
        x.expand(*batch, *x.shape[lead:]).reshape(batch.numel(), *x.shape[lead:])
        for x, lead in zip(operands, leads, strict=True)
    ]
    return torch.vmap(function)(*flat).unflatten(0, batch)
