"""A picture of an explicit law: its regions, and V over them."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

from torch_qpmpc.checks import check_kind, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.proofs.explicit import ExplicitLaw

#: Points of a grid on a side, for V.
GRID = 200


def law_figure(law: ExplicitLaw, *, action: int = 0) -> Figure:
    """Plot the regions of a law of two entries, coloured by an action, and V's level curves.

    Args:
        law: the law.
        action: the index of the action, which colours each region by its value at the middle.

    Raises:
        QPError: ``law`` is no explicit law of two entries, or there is no such action.
    """
    check_kind("law", law, ExplicitLaw)
    if law.basis.shape[1] != 2:
        remedy = "Pass a basis of two directions to explicit_law."
        raise QPError.expected("law", f"{law.basis.shape[1]} entries of s", "two", remedy)
    check_whole("action", action, 0)
    if action >= law.tables.n_u:
        raise QPError.expected("action", f"{action}", f"an index below {law.tables.n_u}")
    corners = [x.vertices[ConvexHull(x.vertices).vertices] for x in law.regions]
    u = [(x.K @ x.vertices.mean(0) + x.k)[action] for x in law.regions]
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    patches = PolyCollection(corners, cmap="coolwarm", edgecolors="black", linewidths=0.4)
    patches.set_array(np.array(u))
    patches.set_norm(Normalize(-(most := max(map(abs, u))), most))
    left.add_collection(patches)
    figure.colorbar(patches, ax=left, label=f"$u_{{0,{action}}}$ at the middle")
    left.set_title(f"{len(law.regions)} regions")
    lower, upper = law.set.lower, law.set.upper
    axes = [np.linspace(a, b, GRID) for a, b in zip(lower, upper, strict=True)]
    V = law.value(np.stack(np.meshgrid(*axes), -1))
    curves = right.contourf(*axes, V, levels=30)
    figure.colorbar(curves, ax=right, label="V")
    right.set_title("V")
    for one in (left, right):
        one.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), xlabel="$s_0$")
        one.set_ylabel("$s_1$")
    return figure
