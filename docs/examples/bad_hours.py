"""Draw a dropout and a transfer to automatic: ``python docs/examples/bad_hours.py FILE.png``."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import torch_qpmpc as qm

A, B, C = np.array([[0.9, 0.0], [0.2, 0.8]]), np.array([[0.25], [0.0]]), np.array([[0.0, 1.0]])
START, LOAD, STEPS = np.array([10.0, 10.0]), -0.8, 90
LOST, MANUAL = range(40, 60), range(30)


def made() -> qm.Controller:
    """Return the controller of the second tank's temperature by the first one's heating."""
    mpc = qm.LinearMPC((A, B, C), 12, outputs=["T"], inputs=["q"], Q=1.0, dR=0.1, u_bounds=(0, 12))
    controller = qm.Controller(mpc, noise=0.05, drift=0.02)
    controller.reset(y=START[1:], u=[4.0])
    return controller


def dropout() -> dict[str, Any]:
    """Return T and q of loops that lose the sensor while the set-point moves."""
    loops = {}
    for name in ("predicted through", "input held"):
        controller, x, rows = made(), START, []
        for k in range(STEPS):
            r, y = 14.0 if k < LOST[5] else 11.0, None if k in LOST else x[1:]
            if k in LOST and name == "input held":
                controller.observe(y, u := controller.u)
            else:
                u = controller.step(y, [r])
            rows.append((x[1], u[0], r))
            x = A @ x + B @ (u + LOAD)
        loops[name] = np.array(rows)
    return loops


def transfer() -> dict[str, Any]:
    """Return T and q of loops that are automatic after manual mode, by `observe` or by `reset`."""
    loops = {}
    for name in ("observed", "reset at the switch"):
        controller, x, rows = made(), START, []
        for k in range(STEPS):
            if k in MANUAL:
                u = np.array([4.0 if k < MANUAL[-5] else 11.0])
                controller.observe(x[1:], u)
            else:
                if k == MANUAL.stop and name != "observed":
                    controller.reset(y=x[1:], u=u)
                u = controller.step(x[1:], [14.0])
            rows.append((x[1], u[0], 14.0))
            x = A @ x + B @ (u + LOAD)
        loops[name] = np.array(rows)
    return loops


def figure() -> Figure:
    """Draw T and its set-point above q, for both."""
    drawn = Figure(figsize=(10, 5), layout="constrained")
    axes = drawn.subplots(2, 2, sharex=True)
    cases = (("dropout", dropout(), LOST), ("from manual to automatic", transfer(), MANUAL))
    for column, (title, loops, span) in enumerate(cases):
        top, bottom = axes[:, column]
        for name, rows in loops.items():
            top.plot(rows[:, 0], label=f"T, {name}")
            bottom.step(range(STEPS), rows[:, 1], where="post", label=f"q, {name}")
        top.plot(rows[:, 2], "k--", lw=0.8, label="set-point")
        top.set_title(title)
        for one in (top, bottom):
            one.axvspan(span.start, span.stop, color="0.9")
            one.legend(fontsize="small")
    axes[0, 0].set_ylabel("T")
    axes[1, 0].set_ylabel("q")
    for one in axes[1]:
        one.set_xlabel("step")
    return drawn


if __name__ == "__main__":
    figure().savefig(sys.argv[1], dpi=80)
