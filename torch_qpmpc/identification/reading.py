"""Logs from what a user has: tables, arrays, or steps of TorchRL."""

from collections.abc import Sequence
from typing import Any

from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.log import Log, named
from torch_qpmpc.identification.steps import is_steps, of_steps


def read_log(
    data: Any,
    outputs: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    known: Sequence[str] | None = None,
    time: str | None = None,
    episode: str | None = None,
    day_first: bool | None = None,
) -> Log:
    """Read a log of a plant: row k has outputs y_k, the inputs u_k applied until k + 1, and d_k.

    A trajectory ends at a gap in ``time``, where ``episode`` changes, and at a row whose input or
    known signal is missing. Missing outputs, such as of a sensor that answers or changes in every
    m-th row only, stay in it as NaN. It begins and ends with an output; its last row needs no more.

    Args:
        data: the path of a CSV file, a DataFrame, a mapping of arrays ``(T,)`` or ``(T, n)``, or a
            list of these, one for each episode; or steps as in `identify`. A unit in a header, as
            in ``T [degC]``, is not part of the name. A shorter array lacks the last row. A file
            with semicolons, tabs or bars may have decimal commas.
        outputs, inputs, known: the names or headers of the columns of y, u and, optionally, d; by
            default ``y``, ``u`` and ``d`` or ``y1``, ``y2``, .. and so on.
        time: the column of times: numbers, dates, periods, time differences or clocks, such as
            ``20260301093000``, ``093000``, ``59:30.5`` or ``24:00``; by default a DataFrame's index
            of these, also as `DataFrame.to_csv` writes it, without a header. Of several readings
            the one with the most even steps counts. A clock may show one time for several rows,
            equal ones count once; an empty time is as far between its neighbours as its row.
        episode: the column of marks that differ between episodes.
        day_first: True for dates such as 29/09/2020, False for 09/29/2020; by default the reading
            with fewer gaps.

    Returns:
        The log. A `UserWarning` names columns that are constant, a linear function of others, or
        with repeats or marks such as -9999 for missing ones, times of two readings, and many gaps.

    Raises:
        QPError: a column is missing, named twice, without numbers or with text such as ``1,5`` or
            ``3 kW``; the sampling time changes; or no rows have outputs and inputs between.

    Example:
        >>> import numpy as np, torch_qpmpc as qm
        >>> rng = np.random.default_rng(0)
        >>> rows = {"T [degC]": rng.normal(size=9), "q": rng.normal(size=9)}
        >>> rows["t"] = [0, 1, 2, 3, 4, 9, 10, 11, 12]
        >>> print(qm.read_log(rows, outputs=["T"], inputs=["q"], time="t"))
        7 steps, one step every 1: outputs T [degC]; inputs q
        9 rows: 1 gap, 2 trajectories, 0.0% of rows dropped
    """
    if is_steps(data):
        if time is not None or episode is not None:
            want = "None for a TensorDict, whose own flags are used"
            raise QPError.expected("time, episode", f"{time!r} and {episode!r}", want)
        n_x = None if outputs is None else len(outputs)
        return named(of_steps(data, n_x, len(known or ())), outputs, inputs, known)
    # Imports pandas, half a second that steps of TorchRL don't need.
    from torch_qpmpc.identification.tables import read_tables

    return read_tables(data, (outputs, inputs, known), time, episode, day_first)


def as_log(data: Any, n_x: int | None = None, n_d: int | None = None) -> Log:
    """Return ``data``, what `identify` takes with ``n_x`` and ``n_d``, as a `Log`."""
    if is_steps(data):
        return named(of_steps(data, n_x, 0 if n_d is None else n_d))
    log = data if isinstance(data, Log) else read_log(data)
    for name, size, names in (("n_x", n_x, log.outputs), ("n_d", n_d, log.known)):
        if size is not None and size != len(names):
            got = f"{size!r}, but {len(names)} of {', '.join(names) or 'none'}"
            raise QPError.expected(name, got, "the log's own", f"Omit {name}.")
    return log
