"""Data that torch sees as tensors and the kernels as arrays: each form is made when asked for.

To turn the one into the other takes as long as a kernel spends on a QP, and most are never asked
for.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar, Generic, Self, TypeVar

import torch
from torch import Tensor

from torch_qpmpc.qp.kernels import per_sample

A = TypeVar("A")


class Twofold(Generic[A]):
    """A dataclass of tensors on one device, or of the named tuple ``Arrays`` of their arrays."""

    Arrays: ClassVar[Any]

    @classmethod
    def of_arrays(cls, arrays: A, device: torch.device, **others: Any) -> Self:
        """From arrays, and ``others``, fields that are none."""
        made = object.__new__(cls)
        vars(made).update(others, arrays=arrays, device=device)
        return made

    @cached_property
    def arrays(self) -> A:
        """The tensors as the kernels take them."""
        return self.Arrays(*per_sample.arrays(*self.all_tensors()))

    @cached_property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return getattr(self, self.Arrays._fields[0]).device

    def all_tensors(self) -> list[Tensor]:
        """Those of ``Arrays``; makes what is not there yet."""
        return [getattr(self, name) for name in self.Arrays._fields]

    def forget_arrays(self) -> None:
        """Tensors have changed: copies of what they were are of no use."""
        self.all_tensors()
        vars(self).pop("arrays", None)

    def __getattr__(self, name: str) -> Tensor:
        # Asked for what is not there, or not yet.
        if "arrays" not in vars(self) or name not in self.Arrays._fields:
            raise AttributeError(f"{type(self).__name__} has no {name!r}")
        (made,) = per_sample.tensors([getattr(self.arrays, name)], self.device)
        vars(self)[name] = made
        return made
