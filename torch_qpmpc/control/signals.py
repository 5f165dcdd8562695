"""Numbers and signals by name: from mappings, DataFrames and arrays to arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torch_qpmpc.control.state_space import Array
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.validation import read_numbers


def read_row(name: str, value: Any, names: Sequence[str]) -> Array:
    """Return one number for each name, from a mapping, a vector or, for one name, a number.

    Raises:
        QPError: a name is missing or unknown, or a number is not finite.
    """
    return read_table(name, value, names, 1)[0]


def read_table(name: str, value: Any, names: Sequence[str], rows: int, least: int = 1) -> Array:
    """Return ``(rows, len(names))`` from a mapping or DataFrame of columns, or an array.

    One row stands for all; a table that ends early holds its last row, and a longer one is cut.

    Raises:
        QPError: a name is missing or unknown, a number is not finite, the shape is wrong, or more
            than one row and fewer than ``least``.
    """
    if hasattr(value, "columns"):  # a DataFrame
        value = {column: value[column].to_numpy() for column in value.columns if column in names}
    if isinstance(value, Mapping):
        if {*value} != {*names}:
            raise QPError.expected(name, f"signals {sorted(value)}", f"those of {sorted(names)}")
        columns = [np.atleast_1d(read_numbers(name, value[x]).numpy()) for x in names]
        try:
            table = np.stack(np.broadcast_arrays(*columns), axis=-1)
        except ValueError as error:
            lengths = [len(x) for x in columns]
            raise QPError.expected(name, f"lengths {lengths}", "columns of one length") from error
    else:
        table = np.atleast_1d(read_numbers(name, value).numpy())
        table = table[None] if table.ndim == 1 else table
    if table.ndim != 2 or table.shape[1] != len(names) or not len(table):
        want = f"{len(names)} numbers ({', '.join(names)}), or rows of these"
        raise QPError.expected(name, f"shape {table.shape}", want)
    if not np.isfinite(table).all():
        raise QPError.expected(name, "NaN or inf", "finite numbers")
    if 1 < len(table) < least:
        raise QPError.expected(name, f"{len(table)} rows", f"one row, or at least {least}")
    held = np.minimum(np.arange(rows), len(table) - 1)
    return table[held]


def read_vector(name: str, value: Any, names: Sequence[str], missing: float) -> Array:
    """Read one number for each name, from a number, a vector or a mapping."""
    if isinstance(value, Mapping):
        if unknown := sorted({*value} - {*names}):
            raise QPError.expected(name, repr(unknown[0]), f"names among {', '.join(names)}")
        value = [value.get(x, missing) for x in names]
    vector = read_numbers(name, value).numpy()
    vector = np.full(len(names), float(vector)) if vector.ndim == 0 else vector.copy()
    if vector.shape != (len(names),) or np.isnan(vector).any():
        want = f"a number, or one for each of {', '.join(names)}"
        raise QPError.expected(name, f"shape {vector.shape} or NaN", want)
    return vector
