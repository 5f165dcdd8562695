"""`identify` on measured data beside N4SID: ``python -m tests.benchmarks.daisy FOLDER``.

    pip install nfoursid

FOLDER has data sets of DaISy (De Moor, De Gersem, De Schutter and Favoreel, 1997): exchanger.dat,
CD_player_arm.dat, evaporator.dat and glassfurnace.dat, as they are on its site. The first half of
each is identified; the errors of the other half's predictions, some steps ahead, are relative to
the outputs' standard deviations there. The inputs of a row act on its outputs, as the report of
`identify` says, so that they move up a row. N4SID is nfoursid's, which has a feedthrough instead,
with the Kalman filter of its covariances and the order, up to `ORDERS`, that predicts the other
half best ten steps ahead.
"""

from __future__ import annotations

import argparse
import contextlib
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.linalg

import torch_qpmpc as qm
from tests.benchmarks.solvers import PAGE
from torch_qpmpc.study.markdown import replaced, table

#: The inputs' and the outputs' columns of each file.
SETS = {
    "exchanger": ([1], [2]),
    "CD_player_arm": ([0, 1], [2, 3]),
    "evaporator": ([0, 1, 2], [3, 4, 5]),
    "glassfurnace": ([1, 2, 3], [4, 5, 6, 7, 8, 9]),
}
AHEAD, ORDERS, BLOCK_ROWS, SETTLED = (1, 10, 30), 10, 15, 50
#: A, B, C, D, K and the offset of x+ = A x + B u + K e + offset, y = C x + D u + e.
Predictor = tuple[np.ndarray, ...]


def errors(model: Predictor, y: np.ndarray, u: np.ndarray) -> list[float]:
    """Return the relative root mean square errors ``AHEAD`` steps ahead, of all outputs."""
    A, B, C, D, K, offset = model
    x, after = np.zeros(len(A)), []
    for k in range(len(y)):
        after.append(x)
        x = A @ x + B @ u[k] + K @ (y[k] - C @ x - D @ u[k]) + offset
    x, found = np.array(after), []
    for k in range(max(AHEAD)):  # x[i] is the prediction of x_{i + k} from y_{i - 1}
        if k + 1 in AHEAD:
            rest = slice(SETTLED + k, None)
            error = (y[rest] - (x @ C.T)[SETTLED : len(y) - k] - (u @ D.T)[rest]) / y.std(0)
            found.append(float(np.sqrt((error**2).mean())))
        x = x @ A.T + offset
        x[: len(u) - k] += u[k:] @ B.T
    return found


def framed(y: np.ndarray, u: np.ndarray) -> tuple[pd.DataFrame, tuple[list[str], list[str]]]:
    """Return the signals as columns, and the names of outputs and inputs."""
    names = [f"y{i}" for i in range(y.shape[1])], [f"u{i}" for i in range(u.shape[1])]
    return pd.DataFrame(np.hstack((y, u)), columns=pd.Index([*names[0], *names[1]])), names


def ours(y: np.ndarray, u: np.ndarray) -> Predictor:
    """Identify a model in innovations form."""
    frame, names = framed(y, u)
    model = qm.identify(qm.read_log(frame, outputs=names[0], inputs=names[1]), 20).model
    none = np.zeros((y.shape[1], u.shape[1]))
    return model.A, model.B, model.C, none, model.A @ model.L, model.offset


def n4sid(y: np.ndarray, u: np.ndarray, order: int) -> Predictor:
    """Identify a model by N4SID, with its Kalman filter."""
    frame, names = framed(y, u)
    found = import_module("nfoursid.nfoursid").NFourSID(frame, *names, num_block_rows=BLOCK_ROWS)
    found.subspace_identification()
    system, covariance = found.system_identification(rank=order)
    (A, B, C, D), n_y = (getattr(system, name) for name in "abcd"), y.shape[1]
    R, S, Q = covariance[:n_y, :n_y], covariance[:n_y, n_y:], covariance[n_y:, n_y:]
    P: Any = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R, s=S.T)
    K = (A @ P @ C.T + S.T) @ np.linalg.inv(C @ P @ C.T + R)
    return A, B, C, D, K, np.zeros(order)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.daisy", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the data sets are")
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options, lines = parser.parse_args(), []
    for name, columns in SETS.items():
        data = np.loadtxt(options.folder / f"{name}.dat")
        half = len(data) // 2
        u, y = (data[:, part] - data[:half, part].mean(0) for part in columns)
        first, rest = (y[:half], u[:half]), (y[half:], u[half:])
        above = [(part[0][:-1], part[1][1:]) for part in (first, rest)]
        model, others = ours(*above[0]), {}
        for order in range(1, ORDERS + 1):
            with contextlib.suppress(np.linalg.LinAlgError, ValueError):
                others[order] = errors(n4sid(*first, order), *rest)
        best = min(others, key=lambda order: others[order][1])
        for label, order, found in (
            ("`identify`", len(model[0]), errors(model, *above[1])),
            ("N4SID", best, others[best]),
        ):
            lines.append([name, label, f"{order}", *(f"{x:.3f}" for x in found)])
            print(*lines[-1], flush=True)
    text = table(["", "", "order", *(f"{k} ahead" for k in AHEAD)], lines)
    if options.write:
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(replaced(page, text, "daisy"), encoding="utf-8")


if __name__ == "__main__":
    main()
