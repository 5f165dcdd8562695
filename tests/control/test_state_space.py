"""Models from matrices, systems and identifications, and messages."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy.integrate
import scipy.signal
import torch

from tests.refused import refused
from torch_qpmpc import QPError, read_log
from torch_qpmpc.control.state_space import read_model
from torch_qpmpc.identification.identification import Identified
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.identification.log import Log, Trajectory
from torch_qpmpc.identification.subspace import Fit

A, B = np.array([[0.0, 1.0], [-1.0, -0.5]]), np.array([[0.0], [1.0]])
C, D = np.array([[1.0, 0.0]]), np.array([[0.0]])


def system(**changes):
    return SimpleNamespace(**{"A": A, "B": B, "C": C, "D": D, "dt": 0, **changes})


def test_a_continuous_system_is_sampled_by_zero_order_hold():
    plant = read_model(system(input_labels=["F"], output_labels=["position"]), dt=0.2)
    x = np.array([1.0, -1.0])
    held = scipy.integrate.solve_ivp(lambda _, x: A @ x + B[:, 0] * 2, (0, 0.2), x, rtol=1e-9)
    assert np.allclose(plant.A @ x + plant.B[:, 0] * 2, held.y[:, -1], atol=1e-7)
    assert (plant.dt, plant.inputs, plant.outputs) == (0.2, ("F",), ("position",))
    twin = read_model(scipy.signal.lti(A, B, C, D), dt=0.2)
    assert np.array_equal(twin.A, plant.A)


def test_known_signals_of_a_continuous_system_are_sampled_with_it():
    plant = read_model(scipy.signal.lti(A, B, C, D), E=3 * B, dt=0.2)
    assert np.allclose(plant.E, 3 * plant.B)
    assert np.array_equal(read_model(system(dt=0.2), E=3 * B).E, 3 * B)


def test_a_discrete_system_keeps_its_matrices_and_time():
    plant = read_model(scipy.signal.dlti(A, B, C, D, dt=0.5))
    assert np.array_equal(plant.A, A)
    assert (plant.dt, plant.inputs) == (0.5, ("u1",))
    assert read_model(system(dt=True), dt=0.3).dt == 0.3
    transfer = scipy.signal.dlti([0.5], [1.0, -0.9], dt=1.0)
    assert np.allclose(read_model(transfer).A, [[0.9]])


@pytest.mark.parametrize("names", [np.array, pd.Index, tuple, list])
def test_names_are_any_sequence_or_one(names):
    plant = read_model((A, B), inputs="force", outputs=names(["T", "h"]), known=names(["d", "e"]))
    assert (plant.inputs, plant.outputs, plant.known) == (("force",), ("T", "h"), ("d", "e"))
    frame = pd.DataFrame({"force": [0.0, 1.0, 0.0], "T": [1.0, 2.0, 4.0], "h": [0.0, 1.0, 3.0]})
    log = read_log(frame, outputs=names(["T", "h"]), inputs="force")
    assert (log.inputs, log.outputs) == (("force",), ("T", "h"))


def test_named_inputs_of_a_system_become_known_signals():
    two = system(B=[[0.0, 3.0], [1.0, 4.0]], D=[[0.0, 0.0]], dt=1.0, input_labels=["q", "T_out"])
    plant = read_model(two, known=["T_out"])
    assert plant.inputs == ("q",)
    assert plant.known == ("T_out",)
    assert plant.E.tolist() == [[3.0], [4.0]]


def test_matrices_without_an_output_measure_the_state():
    assert np.array_equal(read_model((A, B)).C, np.eye(2))
    assert read_model((A, B), E=np.ones((2, 2))).known == ("d1", "d2")


def test_the_state_space_of_an_identification_has_its_predictions():
    rng = np.random.default_rng(0)
    shapes = {"A": (3, 3), "B": (3, 1), "E": (3, 1), "offset": (3,), "C": (2, 3), "L": (3, 2)}
    parts = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    model = Innovations(**parts, S=np.eye(2), x0=np.zeros(3), P0=np.zeros((3, 3)))
    y, u, d = (torch.from_numpy(rng.normal(size=shape)) for shape in ((4, 2), (3, 1), (3, 1)))
    log = Log([Trajectory(y, u, d)], ("level", "flow"), ("pump",), ("rain",), dt=0.5)
    found = Identified(model, log, 1, Fit(model, 3, 2))
    plant = read_model(found)
    assert (plant.outputs, plant.inputs, plant.known) == (log.outputs, log.inputs, log.known)
    assert plant.dt == 0.5
    for name in ("A", "B", "E", "offset", "C"):
        assert np.array_equal(getattr(plant, name), parts[name])
    with pytest.raises(QPError, match=r"^dt: got 1.0, expected the model's own 0.5. Leave dt out"):
        read_model(found, dt=1.0)
    with pytest.raises(QPError, match=r"^E: got \[1.0\], expected None, as the identification has"):
        read_model(found, E=[1.0])
    seen = model.estimates(y.numpy(), u.numpy(), d.numpy())[:-1]
    x = seen @ model.A.T + model.inputs(u.numpy(), d.numpy())
    assert np.allclose(plant.visited[0], x.mean(0))
    assert np.allclose(plant.visited[1], np.cov(x.T, bias=True))
    assert not read_model(found, prices=["rain"]).E.any(), "a price acts on no plant"
    more = read_model(found, known=["price", "rain", "sun"])
    assert np.array_equal(more.E, np.pad(plant.E, ((0, 0), (1, 1))))
    message = r"known: got \['price'\], expected all known .* rain. Pass known=\['rain', 'price'\]"
    with pytest.raises(QPError, match=message):
        read_model(found, known=["price"], prices=["price"])


@refused(
    (5.0, {}, r"model: got float, expected \(A, B\), .* Convert a transfer function"),
    (system(D=[[1.0]]), {"dt": 1.0}, "model: got a direct feedthrough D, expected D = 0"),
    (system(), {}, "dt: got None for a continuous model, expected a sampling time"),
    (system(), {"dt": -1.0}, "dt: got -1.0, expected a sampling time > 0"),
    (system(dt=None), {"dt": 1.0}, "model: got no time base, .* Set model.dt: 0 if it is"),
    (system(dt=0.1), {"dt": 0.2}, "dt: got 0.2, expected the model's own 0.1"),
    ((A, B, C), {"dt": 20}, r"dt: got 20 with matrices, expected None: .* scipy.signal.lti\(A"),
    (read_model((A, B)), {"dt": 0.1}, "dt: got 0.1, expected None, as a StateSpace"),
    (read_model((A, B)), {"known": ["d"]}, r"known: got \['d'\], expected None"),
    ((A, [1.0, 2.0]), {}, r"model\[1\]: got shape \(2,\), expected a matrix"),
    ((A, np.ones((3, 1))), {}, r"B: got shape \(3, 1\), expected \(2, 1\)"),
    ((A, B, np.ones((1, 3))), {}, r"C_y: got shape \(1, 3\), expected \(1, 2\)"),
    ((A, B), {"inputs": ["y1"]}, "names: got 'y1', expected different strings. Inputs, outputs a"),
    ((A, B), {"inputs": 3}, "names: got 3, expected different strings"),
    ((A, B), {"outputs": ["T"]}, r"C_y: got shape \(2, 2\), expected \(1, 2\). Each .* one name"),
    ((A, B), {"E": np.ones((2, 1)), "known": ["a", "b"]}, r"E: got shape \(2, 1\), expected"),
    (system(dt=1.0, input_labels=["q"]), {"known": ["T"]}, "known: got 'T', expected inputs among"),
)
def test_models_that_do_not_fit_are_named(model, arguments):
    read_model(model, **arguments)
