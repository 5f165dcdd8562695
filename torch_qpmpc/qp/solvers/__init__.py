"""The backends, one per file, which solve reduced QPs (eq:qp2, eq:qp3).

A backend is a function ``solve(qps: SoftQPs) -> BackendSolution`` of QPs with at least one row. To
add one, write its file and list it in `BACKENDS`.
"""

import difflib
from collections.abc import Callable
from functools import partial

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.pipeline.arrays import BackendSolution, SoftQPs
from torch_qpmpc.qp.solvers import daqp, interior_point, proxqp, qpsolvers

Backend = Callable[[SoftQPs], BackendSolution]

BACKENDS: dict[str, Backend] = {
    "proxqp": proxqp.solve,
    "daqp": daqp.solve,
    "torch": interior_point.solve,
}


def backend(name: str) -> Backend:
    """Return the backend called ``name``; raise `QPError` if there is none."""
    if name in BACKENDS:
        return BACKENDS[name]
    if isinstance(name, str) and name.startswith("qpsolvers:"):
        wrapped = name.removeprefix("qpsolvers:")
        qpsolvers.check_available(wrapped)
        return partial(qpsolvers.solve, name=wrapped)
    close = difflib.get_close_matches(str(name), BACKENDS, n=1)
    raise QPError.expected(
        "solver",
        repr(name),
        f"one of {', '.join(BACKENDS)}, qpsolvers:NAME",
        f"Did you mean {close[0]!r}?" if close else "",
    )


__all__ = ["BACKENDS", "Backend", "BackendSolution", "backend"]
