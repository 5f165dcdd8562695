"""`identify` on public measured logs beside an own ARX: ``python -m tests.benchmarks.public_logs``.

FOLDER has the files of `LOGS` under their own names: those of DaISy (De Moor, De Gersem, De
Schutter and Favoreel, 1997), of the Temperature Control Lab (APMonitor/arduino and
jckantor/cbe30338-book on GitHub), Box and Jenkins' gas furnace, the cascaded tanks of the nonlinear
benchmarks and sysidentpy's buck converter. Absent files are left out.

The first rows of each log are identified. The ARX is fitted to the same rows by least squares; the
last 30 % of them choose its order. Both predict the rows after these, twenty steps ahead. Errors
are relative to the outputs' standard deviations there, and geometric means of those after each of
`SPLITS`, the shares of the log that are identified. At most the first `ROWS` rows are read.
"""

import argparse
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

import torch_qpmpc as qm
from tests.benchmarks.table import DOCS, table, write_section

PAGE = DOCS / "results" / "outside.md"
ROWS, SPLITS, CHOOSING, AHEAD, SETTLED = 2000, (0.5, 0.6, 0.7), 0.3, 20, 20
LAGS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20)


class Source(NamedTuple):
    """A file, and the columns of its outputs and inputs."""

    file: str
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]


LOGS = {
    "ball and beam": Source("ballbeam.dat", (1,), (0,)),
    "CD player's arm": Source("CD_player_arm.dat", (2, 3), (0, 1)),
    "stirred tank": Source("cstr.dat", (2, 3), (1,)),
    "hair dryer": Source("dryer.dat", (1,), (0,)),
    "industrial dryer": Source("dryer2.dat", (4, 5, 6), (1, 2, 3)),
    "evaporator": Source("evaporator.dat", (3, 4, 5), (0, 1, 2)),
    "heat exchanger": Source("exchanger.dat", (2,), (1,)),
    "wing flutter": Source("flutter.dat", (1,), (0,)),
    "glass furnace": Source("glassfurnace.dat", (4, 5, 6, 7, 8, 9), (1, 2, 3)),
    "lamp": Source("heating_system.dat", (2,), (1,)),
    "pH": Source("pHdata.dat", (3,), (1, 2)),
    "power plant": Source("powerplant.dat", (6, 7, 8), (1, 2, 3, 4, 5)),
    "robot arm": Source("robot_arm.dat", (1,), (0,)),
    "steam generator": Source("steamgen.dat", (5, 6, 7, 8), (1, 2, 3, 4)),
    "heat through a wall": Source("thermic_res_wall.dat", (2,), (0, 1)),
    "winding": Source("winding.dat", (5, 6), (0, 1, 2, 3, 4)),
    "TCLab, steps": Source("tclab_step_test.csv", (2,), (1,)),
    "TCLab, volts": Source("tclab_volts.csv", (2,), (1,)),
    "TCLab, 2 x 2": Source("tclab_energy.csv", (3, 4), (1, 2)),
    "TCLab, 201 rows": Source("tclab_2x2.csv", (3, 4), (1, 2)),
    "cascaded tanks": Source("cascaded_tanks.csv", (2,), (0,)),
    "gas furnace": Source("gas_furnace.csv", (1,), (0,)),
    "buck converter": Source("buck_id.csv", (2,), (1,)),
}


def read(path: Path, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs ``(T + 1, n_y)`` and inputs ``(T, n_u)``."""
    if path.suffix == ".dat":
        data = np.loadtxt(path)
    else:
        data = pd.read_csv(path, header=None).apply(pd.to_numeric, errors="coerce").to_numpy()
    data = data[np.isfinite(data[:, [*source.outputs, *source.inputs]]).all(1)][:ROWS]
    return data[:, source.outputs], data[:-1, source.inputs]


def arx(y: np.ndarray, u: np.ndarray, lags: int) -> np.ndarray:
    """Fit y_{k+1} to the last outputs and inputs and 1, by least squares."""
    return np.linalg.lstsq(regressors(y, u, lags)[:-1], y[lags:], rcond=None)[0]


def regressors(y: np.ndarray, u: np.ndarray, lags: int) -> np.ndarray:
    """Return the rows from which y_lags, .. are predicted, the newest first."""
    T = len(y) - lags + 1
    u = np.vstack((u, np.zeros((1, u.shape[1]))))
    past = [x[lags - 1 - i : lags - 1 - i + T] for x in (y, u) for i in range(lags)]
    return np.hstack((*past, np.ones((T, 1))))


def arx_error(W: np.ndarray, y: np.ndarray, u: np.ndarray, lags: int, size: np.ndarray) -> float:
    """Return the relative root mean square error of the predictions, `AHEAD` steps ahead."""
    n_y, n_u = y.shape[1], u.shape[1]
    X = regressors(y, u, lags)
    first = max(SETTLED - lags + 1, 0)
    X = X[first : len(u) - AHEAD - lags + 2]
    k = np.arange(len(X)) + first + lags - 1
    for step in range(AHEAD):
        X[:, lags * n_y : lags * n_y + n_u] = u[k + step]
        y_next = X @ W
        X[:, n_y : lags * n_y] = X[:, : (lags - 1) * n_y].copy()
        X[:, :n_y] = y_next
        past = X[:, lags * n_y : lags * (n_y + n_u)]
        past[:, n_u:] = past[:, :-n_u].copy()
    return float(np.sqrt((((X[:, :n_y] - y[k + AHEAD]) / size) ** 2).mean()))


def compared(y: np.ndarray, u: np.ndarray, cut: int) -> tuple[int, float, int, float]:
    """Return order and error of the model of ``cut`` rows, and lags and error of the ARX."""
    choose = round((1 - CHOOSING) * cut)
    first, rest = (y[: cut + 1], u[:cut]), (y[cut:], u[cut:])
    size, tries = rest[0].std(0), {}
    for n in LAGS:
        if n * (y.shape[1] + u.shape[1]) + 1 < choose - n - AHEAD:
            W = arx(y[: choose + 1], u[:choose], n)
            tries[n] = arx_error(W, y[choose : cut + 1], u[choose:cut], n, size)
    lags = min(tries, key=lambda n: (not np.isfinite(tries[n]), tries[n]))
    other = arx_error(arx(*first, lags), *rest, lags, size)
    found = qm.identify({"y": first[0], "u": first[1]}, AHEAD)
    errors = found.model.errors(*rest, np.zeros((len(rest[1]), 0)), AHEAD)[SETTLED:, -1]
    own = float(np.sqrt(np.nanmean((errors / size) ** 2)))
    return found.fit.order, own, lags, other


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.public_logs")
    parser.add_argument("folder", type=Path, help="where the logs are")
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    options, lines, ratios = parser.parse_args(), [], []
    warnings.simplefilter("ignore")
    for name, source in LOGS.items():
        path = options.folder / source.file
        if not path.exists():
            continue
        y, u = read(path, source)
        start = time.process_time()
        rows = [compared(y, u, round(share * len(u))) for share in SPLITS]
        orders, own, lags, other = zip(*rows, strict=True)
        errors = [float(np.exp(np.mean(np.log(x)))) for x in (own, other)]
        ratios.append(errors[0] / errors[1])
        lines.append([name, *(f"{x:.3f}" for x in errors), f"{ratios[-1]:.2f}"])
        sizes = f"{len(u)} rows, {y.shape[1]} x {u.shape[1]}, orders {orders}, lags {lags}"
        print(*lines[-1], sizes, f"{time.process_time() - start:.1f} s", sep="  ", flush=True)
    print(f"median {np.median(ratios):.2f}, largest {max(ratios):.2f}")
    head = ["", "`identify`", "ARX", "ratio"]
    if options.write:
        write_section(PAGE, table(head, lines), "logs")


if __name__ == "__main__":
    main()
