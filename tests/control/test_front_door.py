"""From a CSV file to C: what a person types, as a whole."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest

import torch_qpmpc as qm
from torch_qpmpc.export.library import compiler


def write_log(path):
    """Write the log of a heated tank with noise, as a CSV file."""
    rng, steps = np.random.default_rng(0), 600
    q = rng.uniform(0, 12, steps // 10).repeat(10)
    T_out = 5 + 4 * np.sin(np.arange(steps) / 40)
    T = np.full(steps, 18.0)
    for k in range(steps - 1):
        T[k + 1] = T[k] + 0.1 * (T_out[k] - T[k]) + 0.25 * q[k] + 0.05 * rng.normal()
    price = 0.2 + 0.1 * (np.arange(steps) % 96 > 48)
    columns = {"t": 900.0 * np.arange(steps), "T [degC]": T, "q [kW]": q}
    pd.DataFrame({**columns, "T_out": T_out, "price": price}).to_csv(path, index=False)


@pytest.mark.skipif(compiler() is None or not shutil.which("make"), reason="no C compiler or make")
def test_a_log_becomes_a_controller_in_c(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_log("reactor.csv")
    known = ["T_out", "price"]
    log = qm.read_log("reactor.csv", outputs=["T"], inputs=["q"], known=known, time="t")
    model = qm.identify(log, horizon=24, past=4, structure="tied")
    mpc = qm.LinearMPC(
        model,
        horizon=24,
        Q={"T": 1.0},
        R={"q": 0.0},
        dR={"q": 0.1},
        y_bounds={"T": (18.0, 24.0)},
        u_bounds={"q": (0.0, 12.0)},
        du_bounds={"q": (-3.0, 3.0)},
        linear={"q": "price"},
    )
    controller = qm.Controller(mpc)
    forecast = pd.DataFrame({"T_out": 5.0 + 0.1 * np.arange(25), "price": np.full(25, 0.2)})
    u = controller.step(y={"T": 20.5}, r={"T": 21.0}, known=forecast)
    assert 0 <= u["q"] <= 12
    review = controller.review()
    assert review.faults == [], str(review)
    controller.save("reactor.qpmpc")
    twin = qm.Controller.load("reactor.qpmpc")
    inputs = (x.step(y={"T": 20.6}, known=forecast)["q"] for x in (twin, controller))
    assert len({*inputs}) == 1
    result = controller.learn(log, steps=10, pairs=16)
    assert not result.accepted, "two thirds of the same log are no better"
    assert result.transitions == 399
    report = twin.export_c("c/")
    assert report.difference is not None
    assert report.difference < 1e-9
    assert "y and r: T [degC]" in (tmp_path / "c" / "policy.h").read_text()
    subprocess.run(["make", "run", "CFLAGS=-O1"], cwd="c", check=True, capture_output=True)
