"""Write the C files of a policy: the template policy.c with the tables of one QP."""

import datetime
import math
import re
import sys
from collections.abc import Mapping, Sequence
from importlib import resources
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np

from torch_qpmpc.export.tables import Array, Tables
from torch_qpmpc.mpc.module import QPMPC

_CONSTANTS = {
    "BIG": ("1e300", "1e30f"),
    "TOLERANCE": ("1e-11", "4e-6f"),
    "TIGHT": ("1e-14", "4e-7f"),
    "EPSILON": ("2.2e-16", "1.2e-7f"),
    "ROUNDING": ("4e-15", "1e-6f"),
    "DEPENDENT": ("1e-12", "1e-5f"),
    "NOISE": ("1e-10", "1e-3f"),
    "FEASIBLE": ("1e-8", "1e-4f"),
    "KNOWN_FEASIBLE": ("1e-6", "1e-5f"),
    "GAP": ("1e-9", "1e-4f"),
    "GAIN": ("1e-13", "1e-6f"),
    "COARSE": ("1e-6", "1e-4f"),
}
REAL = {"float64": "double", "float32": "float"}
#: Tolerances by dtype, of which `torch_qpmpc/export/policy.c` explains the use.
CONSTANTS = {x: {key: pair[i] for key, pair in _CONSTANTS.items()} for i, x in enumerate(REAL)}
#: Largest differences in the self-test, relative to the largest expected action and value.
NEAR, NEAR_VALUE = {"float64": 1e-6, "float32": 1e-3}, {"float64": 1e-8, "float32": 1e-4}
#: The rounding of a value, in units in the last place of its terms, which may cancel.
ROUNDING = 64
WIDTH = 100


class Examples(NamedTuple):
    """The S states of the self-test: their kinds, p ``(S, n_p)`` and the expected results there.

    These are codes, u ``(S, n_u)`` and values, the latter with sizes and terms that they are judged
    by, ``(S,)`` each, and the sizes of actions ``(n_u,)``.
    """

    kinds: Sequence[str]
    p: Array
    codes: Array
    u: Array
    values: Array
    sizes: Array
    terms: Array
    of_u: Array


class Settings(NamedTuple):
    """Choices of `export_c`."""

    name: str
    dtype: str = "float64"
    max_iterations: int | None = None


def sources(tables: Tables, settings: Settings, header: str, examples: Examples) -> dict[str, str]:
    """Return the texts of ``name.h`` and ``name.c``."""
    parts = {
        "/* @HEADER@ */": header,
        "@REAL@": REAL[settings.dtype],
        "/* @SIZES@ */": "\n".join(
            f"#define {settings.name.upper()}_{key} {size}"
            for key, size in sizes_of(tables).items()
        ),
        "/* @TABLES@ */": _tables(tables, settings),
        "/* @LEVELS@ */": filled("levels.c", settings.name) if tables.levels else "",
        "/* @EXAMPLES@ */": _examples(settings, examples),
    }
    return {f"{settings.name}.{end}": filled(f"policy.{end}", settings.name, parts) for end in "hc"}


def filled(template: str, name: str, parts: Mapping[str, str] | None = None) -> str:
    """Return a template of this folder with its names and parts replaced."""
    text = resources.files("torch_qpmpc.export").joinpath(template).read_text(encoding="utf-8")
    named = {"policy": name, "POLICY": name.upper()}
    text = re.sub("policy|POLICY", lambda match: named[match[0]], text)  # at once: MY_POLICY
    for mark, part in (parts or {}).items():
        text = text.replace(mark, part)
    return text


def header(mpc: QPMPC, tables: Tables, settings: Settings) -> str:
    """Return the comment at the head of both files."""
    today, version = datetime.date.today(), sys.modules["torch_qpmpc"].__version__
    stages = [(f"d_{k}", mpc.n_d) for k in range(mpc.horizon + 1) if mpc.n_d]
    ends = np.cumsum([0, *(size for _, size in stages), mpc.n_x])
    names = [name for name, _ in stages] + ["x_0"]
    lines = [
        f"{settings.name}: the policy and value of a quadratic program, by torch_qpmpc "
        f"{version} on {today.isoformat()}.",
        f"The state has @BYTES@ bytes. A QP takes at most {settings.max_iterations} iterations.",
        *[f"A step solves at most {x.max_nodes + 1}." for x in [tables.levels] if x],
        f"SHA-256 of H, q, c, C, b, G, lb, ub, w: {tables.digest}",
        "",
        *(f"{_entries('p', *ends[i : i + 2])}: {name}" for i, name in enumerate(names)),
        f"{_entries('u', 0, mpc.n_u)}: u_0",
    ]
    return comment(lines)


def _entries(vector: str, start: int, end: int) -> str:
    return f"{vector}[{start}]" if end == start + 1 else f"{vector}[{start} .. {end - 1}]"


def comment(lines: Sequence[str]) -> str:
    """Return lines of any text as a comment in C."""
    return "/* " + "\n   ".join(map(_harmless, lines)).rstrip() + " */"


def _harmless(line: str) -> str:
    """Return a line that neither ends nor continues a comment, nor splices lines."""
    line = "".join(x if x.isprintable() else " " for x in line)
    for ends in ("*/", "/*", "??"):  # ??/ is a backslash
        while ends in line:
            line = line.replace(ends, " ".join(ends))
    return line


def sizes_of(tables: Tables) -> dict[str, int]:
    """Return the sizes in the header, by the macro's name without the prefix."""
    r, d = tables.R.shape
    most = min(r, d)  # rows that are held at once
    sizes = {"N_P": tables.n_p, "N_U": tables.n_u, "ROWS": r, "ROWS_": max(r, 1)}
    sizes |= {"KNOWN": len(tables.known.Y), "HELD": most, "HELD_": max(most, 1)}
    sizes |= {"TRIANGLE": max(most * (most + 1) // 2, 1), "LEVELS": 0}
    if levels := tables.levels:
        m, S = levels.rows.shape
        sizes |= {"LEVELS": m, "DECIDED": S, "DECISIONS": m * S, "NODES": levels.max_nodes}
        depth, runs = m * S * (levels.values.shape[1] - 1) + 1, max(levels.rules.sum(1))
        sizes |= {"DEPTH": depth, "RUNS": runs}
    return sizes


def arrays_of(tables: Tables, settings: Settings) -> dict[str, Array]:
    """Return the constant arrays by their names in C."""
    P = np.tril(tables.P, -1) + np.diag(np.diag(tables.P)) / 2
    rows, known = tables.rows, tables.known
    arrays = {
        "Y_P": rows.Y,
        "Y_LOWER": rows.lower,
        "Y_UPPER": rows.upper,
        "W": rows.w,
        "SIZE": rows.size,
        "UNIT": rows.unit,
        "Q": tables.Q,
        "KNOWN_P": known.Y,
        "KNOWN_LOWER": known.lower,
        "KNOWN_UPPER": known.upper,
        "KNOWN_W": known.w,
        "KNOWN_SIZE": known.size,
        "U_P": tables.K,
        "U_OFFSET": tables.k,
        "U_LAMBDA": tables.F,
        "U_LOWER": tables.u_lower,
        "U_UPPER": tables.u_upper,
        "V_PP": P[np.tril_indices(len(P))],
        "V_P": tables.g,
    }
    arrays |= {key: x for key, x in tables.decisions.items() if x.dtype.kind == "f"}
    if tables.levels:
        near = 1e-9 if settings.dtype == "float64" else 1e-5
        arrays["ON_LEVEL"] = near * np.ptp(arrays["LEVEL"], axis=1)
    return arrays


def integers(name: str, x: Any, kind: str = "int") -> str:
    """Return the definition of a constant array of integers, ``(n,)``."""
    return f"static const {kind} {name}[] = {{{', '.join(map(str, x)) or 0}}};"


def _tables(tables: Tables, settings: Settings) -> str:
    dtype = settings.dtype
    constants = {**CONSTANTS[dtype], "MAX_ITERATIONS": settings.max_iterations, "REFINEMENTS": 3}
    lines = [f"#define {name} {value}" for name, value in constants.items()]
    lines += [array(name, x, dtype) for name, x in arrays_of(tables, settings).items()]
    lines.append(f"static const real V_OFFSET = {number(tables.c, dtype)};")
    for key, x in tables.decisions.items():
        kind = "signed char" if x.dtype == np.int8 else "int"
        lines += [integers(key, x.ravel(), kind)] * (x.dtype.kind == "i")
    return "\n".join(lines)


def array(name: str, x: Array, dtype: str) -> str:
    """Return the definition of a constant array; an empty one gets a zero, as C demands."""
    if not x.size:
        x = np.zeros([max(n, 1) for n in x.shape])
    shape = "".join(f"[{n}]" for n in x.shape)
    rows = x if x.ndim == 2 else x[None]
    edges: Any = {"initial_indent": "{", "subsequent_indent": " ", "break_on_hyphens": False}
    texts = (", ".join(number(v, dtype) for v in row) for row in rows)
    body = "},\n".join(fill(text, WIDTH, **edges) for text in texts) + "}"
    body = f"{{\n{body}}}" if x.ndim == 2 else body
    return f"static const real {name}{shape} =\n{body};"


def number(x: float, dtype: str) -> str:
    """Return a C literal that reads back as the same number."""
    if math.isinf(x) or abs(x) >= float(CONSTANTS[dtype]["BIG"].rstrip("f")):
        return "BIG" if x > 0 else "-BIG"
    if dtype == "float64":
        return repr(float(x))
    text = f"{np.float32(x):.9g}"
    return f"{text if {'.', 'e'} & {*text} else f'{text}.0'}f"


def _examples(settings: Settings, examples: Examples) -> str:
    """Return the tables of the self-test, with tolerances relative to the sizes."""
    dtype = settings.dtype
    rounding = ROUNDING * np.finfo(dtype).eps * examples.terms
    arrays = {
        "EXAMPLE_P": examples.p,
        "EXAMPLE_U": examples.u,
        "EXAMPLE_VALUE": examples.values,
        "NEAR_U": NEAR[dtype] * examples.of_u,
        "NEAR_VALUE": NEAR_VALUE[dtype] * examples.sizes + rounding,
    }
    lines = [
        f"/* States of the self-test: {', '.join(examples.kinds)}. */",
        f"#define EXAMPLES {len(examples.kinds)}",
        integers("EXAMPLE_CODE", examples.codes),
    ]
    return "\n".join([*lines, *(array(name, x, dtype) for name, x in arrays.items())])


def table_bytes(tables: Tables, settings: Settings) -> int:
    """Return the size of all tables but those of the self-test."""
    numbers = sum(x.size for x in arrays_of(tables, settings).values()) + 1
    return numbers * np.dtype(settings.dtype).itemsize
