"""`export_c`: a policy as two files of C, checked against an exact solver; `CompiledPolicy`."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_choice, check_kind, check_tensor, check_whole, ungraded
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.comparison import Agreement, choose, compare, states
from torch_qpmpc.export.library import Library, Steps, compiler, required_compiler, written
from torch_qpmpc.export.tables import Tables, make_tables
from torch_qpmpc.export.writer import NEAR, REAL, Settings, header, sources, table_bytes
from torch_qpmpc.mpc.module import QPMPC

#: Largest share of the solvable states that may be uncertified.
UNSOLVED = 0.1
#: The default limit of iterations is ``PER_ROW r + AT_LEAST``.
PER_ROW, AT_LEAST = 20, 100
#: The causes of the codes.
CODES = ("solved", "not certified within max_iterations", "infeasible", "invalid p")
#: Names whose .h would hide a standard header.
HEADERS = (
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal "
    "stdalign stdarg stdatomic stdbool stddef stdint stdio stdlib stdnoreturn string tgmath "
    "threads time uchar wchar wctype"
)


@dataclass(frozen=True)
class Export:
    """Report of `export_c`.

    Attributes:
        files: the paths of ``name.h`` and ``name.c``.
        dtype, max_iterations: as in `export_c`.
        n_p, n_u: the numbers of entries of p and u.
        rows: the number of rows with multipliers.
        variables: the number of free variables of a plan.
        table_bytes, state_bytes: the sizes of the constant tables and of the state; the latter is
            None without a compiler.
        condition: the condition number of the cost on the plan.
        agreement: the measured agreement with an exact solver; None without a compiler.
        digest: the SHA-256 of the nine tensors.

    Example:
        >>> import tempfile, torch_qpmpc as qm
        >>> own = {"stage_weight": [1, 1], "action_bounds": ([-1], [1])}
        >>> mpc = qm.QPMPC.from_model([[1]], [[1]], 3, **own)
        >>> export = qm.export_c(mpc, tempfile.mkdtemp())
        >>> [file.name for file in export.files], export.rows
        (['policy.h', 'policy.c'], 3)
    """

    files: tuple[Path, ...]
    dtype: str
    max_iterations: int
    n_p: int
    n_u: int
    rows: int
    variables: int
    table_bytes: int
    state_bytes: int | None
    condition: float
    agreement: Agreement | None
    digest: str

    def __str__(self) -> str:
        """Return a report of a few lines."""
        lines = [
            f"{', '.join(str(file) for file in self.files)}",
            f"{self.n_p} known entries, {self.n_u} actions, {self.rows} rows, "
            f"{self.variables} variables; {self.dtype}",
            f"tables {self.table_bytes:,} bytes; condition {self.condition:.1e}",
            "not compared with a solver: no C compiler was found",
        ]
        if one := self.agreement:
            lines[-2] += f"; state {self.state_bytes:,} bytes"
            lines[-1] = (
                f"at {one.states} states: actions within {one.u:.1e}, values within "
                f"{one.value:.1e} where solved ({one.solved}); {one.infeasible} infeasible, "
                f"{one.unsolved} unsolved, at most {one.iterations} iterations"
            )
        return "\n".join(lines)


def export_c(
    mpc: QPMPC,
    folder: str | Path,
    *,
    dtype: str = "float64",
    name: str = "policy",
    max_iterations: int | None = None,
) -> Export:
    """Write the policy and value of the current theta as C99 without heap or dependencies.

    The files are ``name.c`` and ``name.h``, whose ``name_step`` maps p to u_0 and V(p); they are
    compared with an exact solver, at states near feasible ones, if a C compiler is installed.

    Args:
        mpc: the QP.
        folder: the folder of both files, created if it does not exist.
        dtype: ``"float64"`` or ``"float32"``, the type of all numbers in C.
        name: the beginning of the names of files and functions.
        max_iterations: the limit of a step; by default 20 per row of G on the plan, plus 100.

    Returns:
        Sizes, conditioning, and the measured agreement.

    Raises:
        QPError: an argument is invalid, the cost is singular on the plan, no state has a solution,
            or the self-test fails.
    """
    export, texts, _ = build(mpc, Settings(name, dtype, max_iterations))
    return replace(export, files=written(folder, texts))


def build(mpc: QPMPC, settings: Settings) -> tuple[Export, dict[str, str], Library | None]:
    """Return a report without files, the texts by file name, and the functions with a compiler."""
    name, dtype, limit = settings
    _check(mpc, settings)
    tables = make_tables(mpc)
    settings = settings._replace(max_iterations=limit or PER_ROW * len(tables.Q) + AT_LEAST)
    p, exact = states(mpc, tables, dtype)
    examples, exact = choose(mpc, p, exact)
    texts = sources(tables, settings, header(mpc, tables, settings), examples)
    library, agreement = None, None
    if compiler() is not None:
        library = Library(texts, name, dtype)
        agreement, error = compare(mpc, tables, library, p, exact)
        solvable, unsolved = agreement.solved + agreement.unsolved, agreement.unsolved
        if limit is None and unsolved > UNSOLVED * solvable:
            refuse(dtype, f"{unsolved} of {solvable} states not certified", tables)
        if not agreement.solved:
            got = f"{limit}, with none of {solvable} states solved"
            remedy = "Raise it, or leave it out."
            raise QPError.expected("max_iterations", got, "a limit that solves some", remedy)
        if not error <= NEAR[dtype]:
            refuse(dtype, f"an action off by {error:.1e} of its size", tables)
        if failed := library.selftest():
            kinds = [*examples.kinds, "invalid"]
            refuse(dtype, f"a failed self-test at state {failed} ({kinds[failed - 1]})", tables)
    elif dtype == "float32":
        remedy = "Install one, or export float64."
        raise QPError.expected("dtype", "'float32' without a C compiler to test it", "one", remedy)
    own = "some" if library is None else str(library.state_bytes)
    texts = {file: text.replace("@BYTES@", own) for file, text in texts.items()}
    sizes = {"n_p": tables.n_p, "n_u": tables.n_u, "rows": len(tables.Q)}
    sizes |= {"variables": tables.R.shape[1], "table_bytes": table_bytes(tables, settings)}
    export = Export(
        files=(),
        dtype=dtype,
        max_iterations=settings.max_iterations or 0,
        state_bytes=None if library is None else library.state_bytes,
        condition=tables.condition,
        agreement=agreement,
        digest=tables.digest,
        **sizes,
    )
    return export, texts, library


def refuse(dtype: str, got: str, of: Tables | Export) -> NoReturn:
    """Raise `QPError`: the C of a plan does not agree with Python."""
    remedy = "Export float64."
    if dtype == "float64":
        cost = f"The cost on the plan has condition {of.condition:.1e}"
        remedy = f"{cost}: lower slack weights (y_slack), shorten the horizon, or rescale states."
    raise QPError.expected("dtype", f"{dtype!r}, with {got}", "C that agrees with Python", remedy)


def _check(mpc: QPMPC, settings: Settings) -> None:
    check_kind("mpc", mpc, QPMPC)
    if (check_linear := getattr(mpc, "check_linear", None)) is not None:  # a `LinearMPC.plan`
        check_linear("C and FMUs")
    check_choice("dtype", settings.dtype, tuple(REAL))
    check_name(settings.name)
    if settings.max_iterations is not None:
        check_whole("max_iterations", settings.max_iterations, 1)


def check_name(name: str) -> None:
    """Raise unless a name can begin those of C files and functions."""
    remedy = "It begins the names of functions and files."
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise QPError.expected("name", repr(name), "a C identifier", remedy)
    if name.lower() in HEADERS.split():
        got = f"{name!r}, whose .h is a standard header"
        raise QPError.expected("name", got, "another C identifier", f"{remedy} Append a _.")


class CompiledPolicy:
    """The policy and value of a QPMPC in compiled C, for fast closed loops.

    It keeps its first theta. Each row of a batch is a controller that starts from its own
    last active set, so that a closed loop of B plants passes ``(B, n_p)`` at each step.

    Args:
        mpc: the QPMPC. With its ``on_failure="raise"`` a step that is not solved raises; otherwise
            the policy returns the action that C writes.
        dtype, max_iterations: as in `export_c`.

    Attributes:
        export: sizes and measured agreement, an `Export`.
        last: the results of the last step: actions, codes, values and their error bounds.

    Raises:
        QPError: no C compiler is installed, or as in `export_c`.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model([[1]], [[1]], 3, stage_weight=[1, 1])
        >>> policy = qm.CompiledPolicy(mpc)
        >>> s = torch.tensor([[1.0], [-0.5]])
        >>> torch.allclose(policy(s), mpc.policy(s))
        True
    """

    def __init__(
        self,
        mpc: QPMPC,
        *,
        dtype: str = "float64",
        max_iterations: int | None = None,
    ) -> None:
        required_compiler()
        self.export, _, library = build(mpc, Settings("policy", dtype, max_iterations))
        assert library is not None
        self._library = library
        self._n_p, self._n_u, self._raises = mpc.n_p, mpc.n_u, mpc.on_failure == "raise"
        self._states, self._count = library.states(1), 1
        self.last: Steps | None = None

    def __call__(self, s: Tensor) -> Tensor:
        """Return pi(s): s ``(*batch, n_p)`` to ``(*batch, n_u)``.

        Raises:
            QPError: the shape or type of s is wrong.
            SolverError: with ``on_failure="raise"``, a step is not solved.
        """
        check_tensor("s", ungraded("s", s), self._n_p)
        p = s.detach().double().cpu().numpy().reshape(-1, self._n_p)
        if len(p) != self._count:
            self._states, self._count = self._library.states(len(p)), len(p)
        self.last = self._library.steps(self._states, p, self._n_u)
        codes = np.bincount(self.last.codes, minlength=len(CODES))
        if self._raises and codes[1:4].any():
            failures = [f"{codes[i]} {CODES[i]}" for i in range(1, len(CODES)) if codes[i]]
            total = f"{codes[1:4].sum()} of {len(p)}"
            raise SolverError(f"{total} steps have no certified solution: {', '.join(failures)}.")
        return torch.from_numpy(self.last.u).to(s).reshape(*s.shape[:-1], self._n_u)

    def value(self, s: Tensor) -> Tensor:
        """Return V(s), a cost to go: s ``(*batch, n_p)`` to ``(*batch,)``; errors as in a call.

        It is inf where a step is not solved, as that of the module.
        """
        self(s)
        assert self.last is not None
        value = np.where(np.isin(self.last.codes, (0, 5)), self.last.value, np.inf)
        return torch.from_numpy(value).to(s).reshape(s.shape[:-1])

    def reset(self) -> None:
        """Forget the last active sets."""
        self._states = self._library.states(self._count)
