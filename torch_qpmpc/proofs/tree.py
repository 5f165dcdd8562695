"""A binary search tree of an explicit law: a few comparisons for each action, and C code of them.

A node compares s with a facet's hyperplane, and a leaf has the one law of its cell. Each node takes
the hyperplane with the smallest larger half of the regions that meet its cell, regions that it cuts
counted on both sides. Regions are cut exactly, by their vertices.

Reference: Tøndel, Johansen and Bemporad (2003), "Evaluation of piecewise affine control via binary
search tree", Automatica 39.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_qpmpc.checks import check_choice, check_kind
from torch_qpmpc.export.export import check_name
from torch_qpmpc.export.writer import REAL, array, comment, filled
from torch_qpmpc.proofs.explicit import ExplicitLaw, check_points
from torch_qpmpc.proofs.polytope import Body, facets

Array = np.ndarray
#: Two laws are one if their numbers differ by less than this, relative to the largest.
SAME = 1e-9
#: A region is on one side of a hyperplane that it exceeds by less than this.
CUT = 1e-9


class _Piece(NamedTuple):
    """A region's part in a node's cell, and its law."""

    body: Body
    law: int


@dataclass(frozen=True, eq=False)
class SearchTree:
    """The affine laws of an explicit law, and the tree that chooses one.

    Attributes:
        law: the explicit law.
        planes: ``(nodes, d + 1)``, a and b; s is on the second side if ``a's > b``.
        children: ``(nodes, 2)``, the node of each side; -1 - i is a leaf of law i.
        laws: ``(laws, n_u, d + 1)``, K and k.
        depth: the most comparisons for an action.
    """

    law: ExplicitLaw
    planes: Array
    children: Array
    laws: Array
    depth: int

    @classmethod
    def of(cls, law: ExplicitLaw) -> SearchTree:
        """Build the tree.

        Raises:
            QPError: ``law`` is no explicit law.

        Example:
            >>> import torch_qpmpc as qm
            >>> from torch_qpmpc.proofs import Polytope, explicit_law
            >>> A, B = [[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]]
            >>> mpc = qm.QPMPC.from_model(
            ...     A, B, 3, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-0.5], [0.5])
            ... )
            >>> law = explicit_law(mpc, Polytope.box([-1.0, -1.0], [1.0, 1.0]))
            >>> tree = SearchTree.of(law)
            >>> tree.policy([1.0, 0.5])
            array([-0.5])
        """
        check_kind("law", law, ExplicitLaw)
        laws, at = _laws(law)
        pieces = [
            _Piece(Body(x.set.A, x.set.b, x.vertices), i)
            for x, i in zip(law.regions, at, strict=True)
        ]
        planes: list[Array] = []
        children: list[list[int]] = []
        depth, waiting = 0, [(pieces, -1, 0, 0)]
        while waiting:
            pieces, parent, side, level = waiting.pop()
            depth = max(depth, level)
            if len({x.law for x in pieces}) > 1:
                child = len(planes)
                plane, halves = _split(pieces)
                planes.append(plane)
                children.append([0, 0])
                waiting += [(half, child, i, level + 1) for i, half in enumerate(halves)]
            else:
                child = -1 - pieces[0].law
            if parent >= 0:
                children[parent][side] = child
        nodes = np.array(planes).reshape(-1, law.basis.shape[1] + 1)
        return cls(law, nodes, np.array(children, int).reshape(-1, 2), laws, depth)

    def policy(self, s: Any) -> Array:
        """Return u_0 ``(*batch, n_u)`` at s ``(*batch, d)``; outside the set, of some law.

        Raises:
            QPError: s has another shape.
        """
        s = check_points(s, self.laws.shape[2] - 1)
        flat = s.reshape(-1, s.shape[-1])
        at = np.full(len(flat), 0 if len(self.planes) else -1)
        while len(inner := np.flatnonzero(at >= 0)):
            planes = self.planes[at[inner]]
            side = (flat[inner] * planes[:, :-1]).sum(1) > planes[:, -1]
            at[inner] = self.children[at[inner], side.astype(int)]
        laws = self.laws[-1 - at]
        u = (laws[..., :-1] @ flat[..., None])[..., 0] + laws[..., -1]
        return u.reshape(*s.shape[:-1], u.shape[-1])

    @property
    def numbers(self) -> int:
        """The numbers that the tables of the C code have, beside two integers for each node."""
        return self.planes.size + self.laws.size + len(self.law.set.b) * self.planes.shape[1]

    def export_c(
        self, folder: str | Path, *, name: str = "explicit_law", dtype: str = "float64"
    ) -> tuple[Path, Path]:
        """Write ``name.h`` and ``name.c`` with the function ``name_action``, and return them.

        Args:
            folder: where to; made if it does not exist.
            name: begins the names of files, types and functions.
            dtype: ``"float64"`` or ``"float32"``.

        Raises:
            QPError: an argument is invalid.
        """
        check_name(name)
        check_choice("dtype", dtype, tuple(REAL))
        within = np.column_stack((self.law.set.A, self.law.set.b))
        sizes = {
            "N_S": self.planes.shape[1] - 1,
            "N_U": self.laws.shape[1],
            "NODES": len(self.planes),
            "FACETS": len(within),
        }
        integers = ", ".join(map(str, self.children.ravel()))
        tables = (
            array("PLANE", self.planes, dtype),
            f"static const int CHILD[] = {{{integers or 0}}};",
            array("LAW", self.laws.reshape(-1, self.laws.shape[2]), dtype),
            array("WITHIN", within, dtype),
        )
        size = np.dtype(dtype).itemsize * self.numbers + 4 * self.children.size
        text = (
            f"{name}: an explicit policy, by torch_qpmpc. {len(self.law.regions)} regions, "
            f"{len(self.laws)} laws, {len(self.planes)} nodes,",
            f"at most {self.depth} comparisons, {size:,} bytes of tables.",
            f"SHA-256 of the QP: {self.law.tables.digest}",
        )
        parts = {
            "/* @HEADER@ */": comment(text),
            "@REAL@": REAL[dtype],
            "/* @SIZES@ */": "\n".join(f"#define {name.upper()}_{k} {n}" for k, n in sizes.items()),
            "/* @TABLES@ */": "\n".join(tables),
            "@ROOT@": str(0 if len(self.planes) else -1),
        }
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        files = folder / f"{name}.h", folder / f"{name}.c"
        for file in files:
            file.write_text(filled(f"explicit{file.suffix}", name, parts), encoding="utf-8")
        return files


def _laws(law: ExplicitLaw) -> tuple[Array, list[int]]:
    """Return the distinct laws, and that of each region."""
    laws: list[Array] = []
    at = []
    for region in law.regions:
        own = np.column_stack((region.K, region.k))
        near = [abs(own - x).max() <= SAME * (1 + abs(own).max()) for x in laws]
        at.append(near.index(True) if any(near) else len(laws))
        if not any(near):
            laws.append(own)
    return np.array(laws), at


def _split(pieces: list[_Piece]) -> tuple[Array, list[list[_Piece]]]:
    """Return the best facet's hyperplane, and the pieces of both sides."""
    planes = np.concatenate([np.column_stack((x.body.A, x.body.b)) for x in pieces])
    flipped = planes[:, :-1][np.arange(len(planes)), (abs(planes[:, :-1]) > CUT).argmax(1)] < 0
    planes[flipped] *= -1
    planes = planes[np.unique(planes.round(8), axis=0, return_index=True)[1]]
    starts = np.cumsum([0, *(len(x.body.vertices) for x in pieces)])[:-1]
    V = np.concatenate([x.body.vertices for x in pieces])
    beyond = V @ planes[:, :-1].T - planes[:, -1]
    first = np.minimum.reduceat(beyond, starts) < -CUT
    second = np.maximum.reduceat(beyond, starts) > CUT
    counts = first.sum(0), second.sum(0)
    order = np.lexsort((np.add(*counts), np.maximum(*counts)))
    best = order[np.minimum(*counts)[order] > 0][0]
    plane, halves = planes[best], ([], [])
    for piece, here, there in zip(pieces, first[:, best], second[:, best], strict=True):
        for half, sign, on in zip(halves, (1.0, -1.0), (here, there), strict=True):
            if on and here and there:
                A = np.vstack((piece.body.A, sign * plane[:-1]))
                body = facets(A, np.append(piece.body.b, sign * plane[-1]))
                if body is not None:
                    half.append(_Piece(body, piece.law))
            elif on:
                half.append(piece)
    return plane, [*halves]
