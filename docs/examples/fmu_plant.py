"""Control an FMU of a Modelica tool, Simulink or a vendor, such as ``room.fmu``.

    python docs/examples/fmu_plant.py room.fmu --inputs heat --outputs T --dt 900

An FMU with inputs, outputs and a step becomes a plant with Gymnasium's ``reset`` and ``step``, as
`Controller.simulate` and `Controller.learn` take it. The program excites it, identifies a model
and closes a loop: pip install torch-qpmpc[fmu].
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

import torch_qpmpc as qm


class Plant:
    """An FMU of FMI 2.0 or 3.0 for co-simulation.

    Args:
        path: the file.
        inputs, outputs: names of its variables, in the controller's order.
        dt: the time between two steps.
        start: other variables that it starts with, by name.
    """

    def __init__(
        self, path: str, inputs: list[str], outputs: list[str], dt: float, **start: float
    ) -> None:
        self.described = read_model_description(path)
        references = {x.name: x.valueReference for x in self.described.modelVariables}
        self.inputs, self.outputs = ([references[x] for x in names] for names in (inputs, outputs))
        self.start = {references[name]: x for name, x in start.items()}
        slave = FMU3Slave if self.described.fmiVersion.startswith("3") else FMU2Slave
        self.fmu, self.dt, self.time = None, dt, 0.0
        self.slave, self.folder = slave, extract(path)

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start again, and return the outputs."""
        del seed
        if self.fmu is not None:
            self.fmu.terminate()
            self.fmu.freeInstance()
        self.fmu = self.slave(
            guid=self.described.guid,
            unzipDirectory=self.folder,
            modelIdentifier=self.described.coSimulation.modelIdentifier,
            instanceName="plant",
        )
        self.fmu.instantiate()
        self.time = 0.0
        if self.slave is FMU2Slave:
            self.fmu.setupExperiment(startTime=0.0)
        self._set([*self.start], [*self.start.values()])
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self._outputs(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold the inputs for a step, and return Gymnasium's five, with the outputs."""
        self._set(self.inputs, np.asarray(action, float).tolist())
        self.fmu.doStep(self.time, self.dt)
        self.time += self.dt
        return self._outputs(), 0.0, False, False, {}

    def _set(self, references: list[int], values: list[float]) -> None:
        put = self.fmu.setReal if self.slave is FMU2Slave else self.fmu.setFloat64
        if references:
            put(references, values)

    def _outputs(self) -> np.ndarray:
        get = self.fmu.getReal if self.slave is FMU2Slave else self.fmu.getFloat64
        return np.array(get(self.outputs))


def controlled(
    plant: Plant, names: dict[str, list[str]], low: float, high: float, steps: int = 600
) -> tuple[qm.Controller, np.ndarray]:
    """Return a controller of a plant from a log of random steps, and the log's mean outputs."""
    rng = np.random.default_rng(0)
    u = rng.uniform(low, high, (steps // 10, len(names["inputs"]))).repeat(10, 0)
    y = np.array([plant.reset()[0], *(plant.step(row)[0] for row in u[:-1])])
    columns = dict(zip((*names["outputs"], *names["inputs"]), np.hstack((y, u)).T, strict=True))
    model = qm.identify(qm.read_log(columns, **names), horizon=20)
    print(model)
    mpc = qm.LinearMPC(model, 20, Q=1.0 / y.var(0), dR=0.1 / u.var(0), u_bounds=(low, high))
    return qm.Controller(mpc), y.mean(0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path")
    parser.add_argument("--inputs", nargs="+", required=True)
    parser.add_argument("--outputs", nargs="+", required=True)
    parser.add_argument("--range", nargs=2, type=float, default=(0.0, 1.0), help="of the inputs")
    parser.add_argument("--dt", type=float, default=1.0)
    chosen = parser.parse_args()
    own = {"inputs": chosen.inputs, "outputs": chosen.outputs}
    plant = Plant(chosen.path, **own, dt=chosen.dt)
    controller, middle = controlled(plant, own, *chosen.range)
    run = controller.simulate(plant, steps=200, r=middle)
    print(run, *controller.review(r=middle).faults, sep="\n")
    run.plot().savefig("fmu.png")
