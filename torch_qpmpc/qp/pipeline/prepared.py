"""The prepared theta: all results that depend on theta alone, computed once for QPs that share it.

Training changes theta once per update and solves V, Q and the policy with it. Each thread caches
its latest thetas by the content of their tensors, so that no in-place update, copied module or
functional call can make a result stale.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch

from torch_qpmpc.qp.pipeline.arrays import Theta, on_device
from torch_qpmpc.qp.pipeline.condensing import (
    Condensed,
    Elimination,
    Forces,
    Reduced,
    Sizes,
    condense,
    convex,
    forces,
    reduce,
    sizes,
)
from torch_qpmpc.qp.pipeline.scaling import Units

T = TypeVar("T")


class Prepared:
    """Theta, and the results that depend on it alone, each computed when first needed.

    Args:
        theta: the data, as NumPy arrays.
        group: the index of each QP's matrices among the M, ``(B,)``; zeros if theta is shared.
        n_kept: the number of leading entries of z that the elimination of C z = b keeps. V and Q
            that keep the same entries share one elimination.
        device: the device for tensors; None for NumPy arrays.
        elimination: the elimination of C z = b; by default that of
            `torch_qpmpc.qp.pipeline.condensing.eliminate`.
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
        self._scaled: Prepared | None = None
        self._known: dict[Any, Any] = {}

    @cached_property
    def shared(self) -> bool:
        """True if the QPs differ only in their fixed entries."""
        return all(len(x) == 1 for x in self.theta)

    @cached_property
    def native_theta(self) -> Theta:
        """Theta on the device."""
        return Theta._make(on_device(x, self.device) for x in self.theta)

    @property
    def valid(self) -> np.ndarray | None:
        """Mask of finite data, lb <= ub and w >= 0, ``(B or 1,)``; None if all are valid."""
        return self._inspected[0]

    @property
    def diagonal(self) -> tuple[bool, bool]:
        """True if all QPs share one diagonal H, and True if they share one diagonal G."""
        return self._inspected[1:]

    @cached_property
    def _inspected(self) -> tuple[np.ndarray | None, bool, bool]:
        return _inspect(self.theta, self.group)

    @cached_property
    def units(self) -> Units | None:
        """Units in which the QPs are solved; None if all are one."""
        return Units.of(self.theta, self.group)

    @property
    def scaled(self) -> Prepared:
        """The same theta, in its `units`."""
        if self._scaled is None:
            assert self.units is not None
            theta = self.units.scaled(self.theta, self.group)
            self._scaled = Prepared(theta, self.group, self.n_kept, self.device)
        return self._scaled

    def condensed(self, n_f: int) -> Condensed:
        """Return the QPs without C z = b, for n_f fixed entries."""
        condensed = self._condensed(self.n_kept)
        deficient = condensed.deficient and self.n_kept > n_f
        return self._condensed(n_f) if deficient else condensed

    def _condensed(self, n_kept: int) -> Condensed:
        return self._once(("condensed", n_kept), lambda: self._condense(n_kept))

    def _condense(self, n_kept: int) -> Condensed:
        if self._scaled is not None and self.units is not None and self.units.one_length:
            return self._scaled._condensed(n_kept).restored(self.units)
        return condense(self.theta, n_kept, self._elimination)

    def reduced(self, n_f: int) -> Reduced:
        """Return the QPs in their free variables, on the device."""
        return self._once(("reduced", n_f), lambda: self._on_device(self._reduced(n_f)))

    def _reduced(self, n_f: int) -> Reduced:
        return self._once(
            ("reduced on the CPU", n_f),
            lambda: reduce(self.condensed(n_f), self.theta, self.group, n_f),
        )

    def convex(self, n_f: int) -> np.ndarray | None:
        """Return the mask of positive semidefinite reduced H, ``(M,)``; None if all are."""
        if self.condensed(n_f).surely_convex:
            return None
        mask = self._once(("convex", n_f), lambda: convex(self._reduced(n_f).H))
        return None if mask.all() else mask

    def forces(self, n_f: int) -> Forces:
        """Return the `Forces` of the reduced QPs, on the device."""

        return self._once(("forces", n_f), lambda: self._on_device(forces(self._reduced(n_f))))

    def sizes(self, n_f: int) -> Sizes:
        """Return the `Sizes` of the reduced QPs, on the device."""

        def make() -> Sizes:
            return self._on_device(sizes(self.condensed(n_f), self.theta, n_f))

        return self._once(("sizes", n_f), make)

    def part(self, group: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, Prepared]:
        """Return the new group and theta of the QPs at ``index``, whose matrices are ``group``."""
        used, group = np.unique(group, return_inverse=True)
        matrices = (x if len(x) == 1 else x[used] for x in self.theta[:3])
        vectors = (x if len(x) == 1 else x[index] for x in self.theta[3:])
        theta = Theta(*matrices, *vectors)
        return group, Prepared(theta, group, self.n_kept, self.device)

    def eliminated(self, elimination: Elimination, n_f: int) -> Prepared:
        """Return the same theta with another elimination of C z = b, which keeps n_f entries."""
        return Prepared(self.theta, self.group, n_f, self.device, elimination)

    def on_cpu(self) -> Prepared:
        """Return the same theta as NumPy arrays."""
        if self.device is None:
            return self
        return Prepared(self.theta, self.group, self.n_kept, None, self._elimination)

    def _on_device(self, arrays: Any) -> Any:
        return type(arrays)._make(
            on_device(x, self.device) if isinstance(x, np.ndarray) else x for x in arrays
        )

    def _once(self, name: Any, make: Callable[[], T]) -> T:
        if name not in self._known:
            self._known[name] = make()
        return self._known[name]


@np.errstate(all="ignore")
def _inspect(theta: Theta, group: np.ndarray) -> tuple[np.ndarray | None, bool, bool]:
    """Return `Prepared.valid` and `Prepared.diagonal`."""
    H, C, G, q, c, b, lb, ub, w = theta
    # A sum is finite if its terms are, but for overflow, which no solver survives either.
    finite = np.isfinite(sum(x.sum((1, 2)) for x in (H, C, G)))
    valid = np.isfinite(q.sum(-1) + b.sum(-1) + c) & (finite if len(H) == 1 else finite[group])
    # False for NaN, such as inf - inf of two bounds of the same infinity.
    valid = valid & (ub - lb >= 0).all(-1) & (w >= 0).all(-1)
    shared = len(H) == 1
    return None if valid.all() else valid, shared and _is_diagonal(H), shared and _is_diagonal(G)


def _is_diagonal(matrices: np.ndarray) -> bool:
    matrix = matrices[0]
    square = matrix.shape[0] == matrix.shape[1]
    return square and np.count_nonzero(matrix) == np.count_nonzero(matrix.diagonal())


class _Latest(threading.local):
    """The latest `Prepared` of this thread, each with the content of its tensors."""

    #: V and Q of an online and a target network.
    SIZE = 4

    def __init__(self) -> None:
        self.entries: list[tuple[tuple, Prepared]] = []


_latest = _Latest()


def prepared_for(data: Sequence[np.ndarray], n_kept: int, device: torch.device | None) -> Prepared:
    """Return the cached preparation of H, q, .., w, which the whole batch shares."""
    kind = (n_kept, device, data[0].dtype, *(x.shape for x in data))
    content = tuple(x.tobytes() for x in data)
    entries = _latest.entries
    for position, ((other_kind, other), prepared) in enumerate(entries):
        if other_kind == kind and other == content:
            entries.insert(0, entries.pop(position))
            return prepared
    theta = Theta.of([x[np.newaxis].copy() for x in data])  # the caller may change its own
    prepared = Prepared(theta, np.zeros(1, np.int64), n_kept, device)
    entries.insert(0, ((kind, content), prepared))
    del entries[_Latest.SIZE :]
    return prepared
