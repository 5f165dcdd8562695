"""What follows from theta alone: made once for all QPs, actions and threads' solves that share it.

Training changes theta once per update and solves V, Q and the policy with it. The latest thetas
are recognised by the content of their tensors, so that no in-place update, copied module or
functional call can make a result stale.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch

from torch_qpmpc.qp.kernels import theta as loops
from torch_qpmpc.qp.pipeline.arrays import Theta, on_device
from torch_qpmpc.qp.pipeline.condensing import (
    Condensed,
    Elimination,
    Forces,
    Reduced,
    condense,
    convex,
    reduce,
)
from torch_qpmpc.qp.pipeline.scaling import Units

T = TypeVar("T")


class Prepared:
    """Theta and what follows from it, each part worked out when it is first needed.

    Args:
        theta: in NumPy's arrays.
        group: which of the M matrices each QP has, ``(B,)``; only its length varies if all of
            theta is shared.
        n_kept: leading entries of z that the elimination of C z = b leaves alone. A V and a Q that
            keep the same share one elimination.
        device: where the QPs are solved, in tensors; None for NumPy's arrays.
        elimination: of C z = b; by default `torch_qpmpc.qp.pipeline.condensing.eliminate`.
    """

    def __init__(
        self,
        theta: Theta,
        group: np.ndarray,
        n_kept: int,
        device: torch.device | None,
        elimination: Elimination | None = None,
    ) -> None:
        self.theta, self.group, self.n_kept, self.device = theta, group, n_kept, device
        self._elimination = elimination
        self._known: dict[Any, Any] = {}

    @cached_property
    def shared(self) -> bool:
        """True if QPs differ in nothing but their fixed entries."""
        return all(len(x) == 1 for x in self.theta)

    @cached_property
    def native_theta(self) -> Theta:
        """Theta where the QPs are solved."""
        return Theta._make(on_device(x, self.device) for x in self.theta)

    @property
    def valid(self) -> np.ndarray | None:
        """Where the data is finite, lb <= ub and w >= 0, ``(B or 1,)``; None if everywhere."""
        return self._inspected[0]

    @property
    def diagonal(self) -> tuple[bool, bool]:
        """True for H and for G if all QPs share one that is diagonal."""
        return self._inspected[1:]

    @cached_property
    def _inspected(self) -> tuple[np.ndarray | None, bool, bool]:
        return loops.inspect(self.theta, self.group)

    @cached_property
    def units(self) -> Units | None:
        """The units that the QPs are solved in; None if they are all one."""
        return Units.of(self.theta, self.group)

    @cached_property
    def scaled(self) -> Prepared:
        """The same theta in its `units`."""
        assert self.units is not None
        theta = self.units.scaled(self.theta, self.group)
        return Prepared(theta, self.group, self.n_kept, self.device)

    def condensed(self, n_f: int) -> Condensed:
        """The QPs without C z = b, for those that fix n_f entries."""
        found = self._once("condensed", lambda: self._condense(self.n_kept))
        if found.deficient and self.n_kept > n_f:
            return self._once(("condensed", n_f), lambda: self._condense(n_f))
        return found

    def _condense(self, n_kept: int) -> Condensed:
        return condense(self.theta, n_kept, self._elimination)

    def reduced(self, n_f: int) -> Reduced:
        """The QPs in their free variables, on the device."""
        return self._once(("reduced", n_f), lambda: self._on_device(self._reduced(n_f)))

    def _reduced(self, n_f: int) -> Reduced:
        return self._once(
            ("reduced here", n_f),
            lambda: reduce(self.condensed(n_f), self.theta, self.group, n_f),
        )

    def convex(self, n_f: int) -> np.ndarray | None:
        """Where the reduced H is positive semidefinite, ``(M,)``; None if everywhere."""
        if self.condensed(n_f).surely_convex:
            return None
        found = self._once(("convex", n_f), lambda: convex(self._reduced(n_f).H))
        return None if found.all() else found

    def forces(self, n_f: int) -> Forces:
        """What tries active sets, on the device."""

        def make() -> Forces:
            reduced = self._reduced(n_f)
            return self._on_device(Forces(*loops.forces(reduced.H, reduced.G)))

        return self._once(("forces", n_f), make)

    def part(self, group: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, Prepared]:
        """Theta of the QPs at ``index``, whose matrices are ``group``; and their new group."""
        used, group = np.unique(group, return_inverse=True)
        matrices = (x if len(x) == 1 else x[used] for x in self.theta[:3])
        vectors = (x if len(x) == 1 else x[index] for x in self.theta[3:])
        theta = Theta(*matrices, *vectors)
        return group, Prepared(theta, group, self.n_kept, self.device)

    def eliminated(self, by: Elimination, n_f: int) -> Prepared:
        """The same theta with another elimination of C z = b, which keeps n_f entries."""
        return Prepared(self.theta, self.group, n_f, self.device, by)

    def on_cpu(self) -> Prepared:
        """The same theta in NumPy's arrays."""
        if self.device is None:
            return self
        return Prepared(self.theta, self.group, self.n_kept, None, self._elimination)

    def _on_device(self, arrays: Any) -> Any:
        return type(arrays)._make(on_device(x, self.device) for x in arrays)

    def _once(self, name: Any, make: Callable[[], T]) -> T:
        if name not in self._known:
            self._known[name] = make()
        return self._known[name]


class _Latest(threading.local):
    """The latest `Prepared` of this thread, by the content of their tensors."""

    #: Online and target networks, of V and Q.
    SIZE = 4

    def __init__(self) -> None:
        self.entries: list[tuple[tuple, Prepared]] = []


_latest = _Latest()


def prepared_for(data: Sequence[np.ndarray], n_kept: int, device: torch.device | None) -> Prepared:
    """What follows from H, q, c, C, b, G, lb, ub, w that a whole batch shares."""
    kind = (n_kept, device, data[0].dtype, *(x.shape for x in data))
    content = tuple(x.tobytes() for x in data)
    entries = _latest.entries
    for position, ((other_kind, other), prepared) in enumerate(entries):
        if other_kind == kind and other == content:
            entries.insert(0, entries.pop(position))
            return prepared
    theta = Theta.of([x[np.newaxis].copy() for x in data])  # the caller's may change
    prepared = Prepared(theta, np.zeros(1, np.int64), n_kept, device)
    entries.insert(0, ((kind, content), prepared))
    del entries[_Latest.SIZE :]
    return prepared
