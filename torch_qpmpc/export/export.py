"""`export_c`: a policy as two files of C, checked against an exact solver."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torch_qpmpc.checks import check_choice, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.export.examples import choose, draw, nearer
from torch_qpmpc.export.library import Library, compiler
from torch_qpmpc.export.reference import LARGE, Reference, reference, sharpen
from torch_qpmpc.export.tables import Array, Tables, make_tables
from torch_qpmpc.export.writer import (
    CONSTANTS,
    NEAR,
    REAL,
    Labels,
    Settings,
    header,
    sources,
    state_bytes,
    table_bytes,
)
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.program import Status

STORAGES = ("fast", "small")
#: Number of random states that the compiled policy is compared at; at least `LEAST` for a `LARGE`
#: QP, whose cold solves take long.
COMPARED, LEAST = 400, 40
#: Largest share of the solvable states that may be uncertified.
UNSOLVED = 0.1
#: Differences above this, relative to the largest action or value, are worth an exact solution.
DOUBTFUL = 1e-9
#: The default limit of iterations is ``PER_ROW r + AT_LEAST``.
PER_ROW, AT_LEAST = 20, 100
#: What a step of an infeasible state returns.
INFEASIBLE = 2
#: Names that the files would hide or that readers would take for something else.
TAKEN = {
    "a keyword of C or C++": """alignas alignof and and_eq asm auto bitand bitor bool break case
        catch char class compl concept const const_cast consteval constexpr constinit continue
        co_await co_return co_yield decltype default delete do double dynamic_cast else enum
        explicit export extern false float for friend goto if inline int long mutable namespace new
        noexcept not not_eq nullptr operator or or_eq private protected public register
        reinterpret_cast requires restrict return short signed sizeof static static_assert
        static_cast struct switch template this thread_local throw true try typedef typeid typename
        typeof union unsigned using virtual void volatile wchar_t while xor xor_eq""",
    "whose .h is a standard header": """assert complex ctype errno fenv inttypes iso646 limits
        locale math setjmp signal stdalign stdarg stdatomic stdbool stddef stdint stdio stdlib
        stdnoreturn string tgmath threads time uchar wchar wctype""",
}


@dataclass(frozen=True)
class Agreement:
    """A compiled policy compared with an exact solver at random states, some far out of bounds.

    Attributes:
        states: the number of states.
        solved: the number of those that both solve, where actions and values are compared.
        infeasible: the number of those that both call infeasible.
        u: the largest difference of an action.
        value: the largest difference of a value, relative to the value.
        unsolved: the number of states that the solver solves and the policy does not.
        iterations: the most iterations from an empty active set.
    """

    states: int
    solved: int
    infeasible: int
    u: float
    value: float
    unsolved: int
    iterations: int


@dataclass(frozen=True)
class Export:
    """Report of `QPMPC.export_c`.

    Attributes:
        files: the paths of ``name.h`` and ``name.c``.
        dtype, storage, max_iterations: as in `QPMPC.export_c`.
        n_p, n_u: the numbers of entries of p and u.
        rows: the number of rows with multipliers.
        variables: the number of free variables of a plan.
        table_bytes, state_bytes: the sizes of the constant tables and of the state.
        condition: the condition number of the cost on the plan.
        agreement: the measured agreement with an exact solver; None without a compiler.
        digest: the SHA-256 of the nine tensors.

    Example:
        >>> import tempfile, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.of(2, 1, 3, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-1.0], [1.0]))
        >>> export = mpc.export_c(tempfile.mkdtemp())
        >>> [file.name for file in export.files], export.rows
        (['policy.h', 'policy.c'], 3)
    """

    files: tuple[Path, ...]
    dtype: str
    storage: str
    max_iterations: int
    n_p: int
    n_u: int
    rows: int
    variables: int
    table_bytes: int
    state_bytes: int
    condition: float
    agreement: Agreement | None
    digest: str

    def __str__(self) -> str:
        """Return a report of a few lines."""
        lines = [
            f"{', '.join(str(file) for file in self.files)}",
            f"{self.n_p} known entries, {self.n_u} actions, {self.rows} rows, "
            f"{self.variables} variables; {self.dtype}, {self.storage}",
            f"tables {self.table_bytes:,} bytes, state {self.state_bytes:,} bytes; condition "
            f"{self.condition:.1e}",
        ]
        if (agreement := self.agreement) is None:
            lines.append("not compared with a solver: no C compiler was found")
        else:
            lines.append(
                f"at {agreement.states} states: actions within {agreement.u:.1e}, values within "
                f"{agreement.value:.1e} where solved ({agreement.solved}); {agreement.infeasible} "
                f"infeasible, {agreement.unsolved} unsolved, at most {agreement.iterations} "
                "iterations"
            )
        return "\n".join(lines)


def export_c(
    mpc: QPMPC,
    folder: str | Path,
    *,
    dtype: str = "float64",
    name: str = "policy",
    max_iterations: int | None = None,
    storage: str = "fast",
    labels: Labels | None = None,
) -> Export:
    """Write a policy as C; see `QPMPC.export_c`."""
    with tempfile.TemporaryDirectory() as temporary:
        export, _ = build(mpc, Path(temporary), dtype, name, max_iterations, storage, labels)
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for file in export.files:
            (folder / file.name).unlink(missing_ok=True)  # may be a link, which copy would follow
        files = tuple(Path(shutil.copy(file, folder)) for file in export.files)
    return Export(**{**vars(export), "files": files})


def build(
    mpc: QPMPC,
    folder: Path,
    dtype: str,
    name: str,
    max_iterations: int | None,
    storage: str,
    labels: Labels | None = None,
) -> tuple[Export, Library | None]:
    """Write, compile and check a policy in an existing folder."""
    _check(mpc, dtype, name, storage, labels)
    if max_iterations is not None:
        check_whole("max_iterations", max_iterations, 1)
    tables = make_tables(mpc)
    limit = max_iterations or PER_ROW * len(tables.rows) + AT_LEAST
    settings = Settings(name, dtype, storage, limit)
    p, exact = _states(mpc, tables, dtype)
    examples, exact = choose(mpc, p, exact)
    texts = sources(tables, settings, header(mpc, tables, settings, labels or {}), examples)
    files = []
    for file, text in texts.items():
        files.append(folder / file)
        files[-1].write_text(text, encoding="utf-8")
    library, agreement = None, None
    if compiler() is not None:
        library = Library(folder, name, dtype)
        agreement, error = _compare(mpc, tables, library, p, exact)
        _check_solved(agreement, dtype, max_iterations, tables)
        if not error <= NEAR[dtype].u:
            _refuse(dtype, f"an action off by {error:.1e} of its size", tables)
        if failed := library.selftest():
            kinds = [*(example.kind for example in examples.states), "invalid"]
            _refuse(dtype, f"a failed self-test at state {failed} ({kinds[failed - 1]})", tables)
    elif dtype == "float32":
        remedy = "Install one, or export float64."
        raise QPError.expected("dtype", "'float32' without a C compiler to test it", "one", remedy)
    export = Export(
        tuple(files),
        dtype,
        storage,
        limit,
        tables.n_p,
        tables.n_u,
        len(tables.rows),
        tables.R.shape[1],
        table_bytes(tables, settings),
        state_bytes(tables, settings),
        tables.condition,
        agreement,
        tables.digest,
    )
    return export, library


def _check_solved(agreement: Agreement, dtype: str, limit: int | None, tables: Tables) -> None:
    """Refuse a policy that solves too few of the states that have solutions, or none."""
    solvable = agreement.solved + agreement.unsolved
    if limit is None and agreement.unsolved > UNSOLVED * solvable:
        _refuse(dtype, f"{agreement.unsolved} of {solvable} states not certified", tables)
    if not agreement.solved:
        got = f"{limit}, with none of {solvable} states solved"
        remedy = "Raise it, or leave it out."
        raise QPError.expected("max_iterations", got, "a limit that solves some", remedy)


def _states(mpc: QPMPC, tables: Tables, dtype: str) -> tuple[Array, Reference]:
    """Draw states in the policy's numbers, most of which have solutions, and solve for them."""

    def solve(p: Array) -> Reference:
        return reference(mpc, p.astype(dtype).astype(np.float64))

    count = int(COMPARED * min(1.0, LARGE / max(len(tables.rows), 1)) ** 2)
    p, exact = nearer(tables, draw(tables, max(count, min(LEAST, COMPARED))), solve)
    return p.astype(dtype).astype(np.float64), exact


def _compare(
    mpc: QPMPC, tables: Tables, library: Library, p: Array, exact: Reference
) -> tuple[Agreement, float]:
    """Return the agreement, and the largest error of an action relative to its size.

    An error within the tolerances of the rows that the action follows from counts as none.
    """
    states = library.states(len(p))
    steps = library.steps(states, p, tables.n_u)
    solvable = exact.status == Status.SOLVED
    both = solvable & (steps.codes == 0)

    def differences(exact: Reference) -> tuple[Array, Array]:
        u = np.abs(steps.u - exact.u).max(-1)
        return u, np.abs(steps.value - exact.value) / (np.abs(exact.value) + 1e-300)

    u, value = differences(exact)
    # Relative to the state's own action, or to a usual one: some drawn states have huge ones.
    sizes = np.abs(exact.u).max(-1)
    sizes = np.fmax(sizes, np.median(sizes[both]) if both.any() else 0).clip(1e-9)
    doubtful = both & ((u > DOUBTFUL * sizes) | (value > DOUBTFUL))
    if library.real == np.float64:
        u, value = differences(sharpen(mpc, p, exact, np.flatnonzero(doubtful)))
    agreement = Agreement(
        states=len(p),
        solved=int(both.sum()),
        infeasible=int(((exact.status == Status.INFEASIBLE) & (steps.codes == INFEASIBLE)).sum()),
        u=float(u[both].max(initial=0)),
        value=float(value[both].max(initial=0)),
        unsolved=int((solvable & ~both).sum()),
        iterations=int(steps.iterations.max(initial=0)),
    )
    errors = np.where(both, u / sizes, 0)
    for i in np.flatnonzero(errors > NEAR[str(library.real)].u):
        lam = library.multipliers(states, len(tables.rows))[i]
        if u[i] <= _tolerance(tables, str(library.real), p[i], lam):
            errors[i] = 0
    return agreement, float(errors.max(initial=0))


def _tolerance(tables: Tables, dtype: str, p: Array, lam: Array) -> float:
    """Return the largest error of u_0 that the tolerances of the held rows allow.

    A held row of policy.c is at its bound to within ``TOLERANCE size + ROUNDING |lam|``. An error
    dy of the held rows h is, by the tables, an error ``F_h Q_hh^-1 dy`` of u_0.
    """
    tight, rounding = (
        float(CONSTANTS[dtype][key].rstrip("f")) for key in ("TOLERANCE", "ROUNDING")
    )
    held = (lam != 0) & (np.abs(lam) < tables.rows.w)
    size = tables.rows.size + np.abs(tables.rows.Y) @ np.abs(p)
    error = tight * size[held] + rounding * np.abs(lam).sum()
    gain = np.linalg.lstsq(tables.Q[np.ix_(held, held)], tables.F[:, held].T, rcond=None)[0]
    return float((error @ np.abs(gain)).max(initial=0))


def _refuse(dtype: str, got: str, tables: Tables) -> None:
    remedy = (
        "Export float64."
        if dtype == "float32"
        else f"The cost on the plan has condition {tables.condition:.1e}: shorten the horizon, or "
        "rescale the states."
    )
    raise QPError.expected("dtype", f"{dtype!r}, with {got}", "a policy that agrees", remedy)


def _check(mpc: QPMPC, dtype: str, name: str, storage: str, labels: Labels | None) -> None:
    check_choice("dtype", dtype, tuple(REAL))
    check_choice("storage", storage, STORAGES)
    check_name(name)
    sizes = {"x": mpc.n_x, "u": mpc.n_u, "d": mpc.n_d}
    if labels is not None and not isinstance(labels, Mapping):
        raise QPError.expected("labels", type(labels).__name__, "a mapping from x, u and d")
    for key, names in (labels or {}).items():
        check_choice("labels", key, tuple(sizes))
        if not isinstance(names, Sequence) or isinstance(names, str) or len(names) != sizes[key]:
            raise QPError.expected(f"labels[{key!r}]", repr(names), f"{sizes[key]} names")
        if not all(isinstance(label, str) for label in names):
            raise QPError.expected(f"labels[{key!r}]", repr(names), "strings")


def check_name(name: str) -> None:
    """Raise unless a name can begin those of C files and functions."""
    remedy = "It begins the names of functions and files."
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise QPError.expected("name", repr(name), "a C identifier", remedy)
    for kind, taken in TAKEN.items():
        if name.lower() in taken.split():
            got = f"{name!r}, {kind}"
            raise QPError.expected("name", got, "another C identifier", f"{remedy} Append a _.")
