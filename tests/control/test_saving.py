"""Saved MPCs and controllers: the same inputs to the last digit, and messages."""

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.control.controllers import A, B, C, learned
from tests.problems import drawn_mpc
from torch_qpmpc import QPError, files

FOLDER = Path(__file__).parent


def inputs(controller: qm.Controller, steps: int = 20) -> np.ndarray:
    rng, x, us = np.random.default_rng(1), controller.x, []
    for k in range(steps):
        y = C @ x + 0.01 * rng.normal(size=1)
        us.append(controller.step(y, [np.sin(k / 5)], known=[[0.3, 0.01 * k]]))
        x = A @ x + B @ (us[-1] + 0.1)
    return np.array(us)


@pytest.mark.parametrize("options", [{}, {"references": "preview"}, {"blocks": [1, 3]}])
def test_a_loaded_controller_goes_on_with_the_same_inputs(tmp_path, options):
    controller = qm.Controller(learned(**options), noise=0.02, drift={"disturbance of valve": 0.5})
    controller.reset(u=[0.1])
    inputs(controller)
    controller.save(tmp_path / "mine.qpmpc")
    twin = qm.Controller.load(tmp_path / "mine.qpmpc")
    assert twin.mpc.plan.learned == controller.mpc.plan.learned
    copies = copy.deepcopy(controller), pickle.loads(pickle.dumps(controller))
    us = inputs(controller)
    for own in (twin, *copies):
        assert np.array_equal(inputs(own), us)
    assert twin._memory.known.tolist() == [0.3, 0.19]
    assert twin.simulate(steps=1).u_last.tolist() == [0.1]
    assert twin.mpc.design.plant.label("level") == "level [m]"
    assert twin.mpc.design.plant.dt == 0.5


def test_a_redesigned_controller_keeps_its_observer_in_a_file(tmp_path):
    """The filter of a new controller would be that of the new bounds."""
    controller = qm.Controller(qm.LinearMPC((A, B, C), 4, Q=1.0, dR=0.1, u_bounds=(-1.0, 1.0)))
    controller.redesign(u_bounds=(-9.0, 9.0), Q=4.0)
    controller.save(tmp_path / "mine")
    twin = qm.Controller.load(tmp_path / "mine")
    assert np.array_equal(twin.observer.L, controller.observer.L)
    assert not np.allclose(qm.Controller(twin.mpc).observer.L, twin.observer.L)
    steps = np.random.default_rng(0).normal(size=(9, 1))
    assert [twin.step(y, [0.5]) for y in steps] == [controller.step(y, [0.5]) for y in steps]


def test_a_controller_is_saved_before_its_first_step_and_without_disturbances(tmp_path):
    controller = qm.Controller(qm.LinearMPC((A, B, C), 5, Q=1.0, R=1.0, disturbances=None))
    controller.save(tmp_path / "mine")
    twin = qm.Controller.load(tmp_path / "mine")
    assert twin.step([1.0], [0.0]) == controller.step([1.0], [0.0])


def test_a_loaded_mpc_is_the_same_and_qpmpc_reads_its_qp(tmp_path):
    mpc = learned()
    mpc.save(tmp_path / "mpc.qpmpc")
    twin = qm.LinearMPC.load(tmp_path / "mpc.qpmpc")
    plain = qm.QPMPC.load(tmp_path / "mpc.qpmpc")
    known = np.ones((5, 2))
    p, own = (x.arrange([0.3, 0.1], x.target([0.5], w=[0.1]), known=known) for x in (twin, mpc))
    assert torch.equal(p, own)
    assert torch.equal(twin.plan.value(p), mpc.plan.value(p))
    assert torch.equal(plain.policy(p), mpc.plan.policy(p))
    twin.plan.reset_parameters()
    mpc.plan.reset_parameters()
    assert torch.equal(twin.plan.value(p), mpc.plan.value(p))


def test_numbers_and_names_of_numpy_are_saved(tmp_path):
    """A file with one of them could not be read."""
    one, (q, y, cap, price) = np.float64(1.0), np.array(["q", "T", "cap", "price"])
    numbers: Any = {
        "horizon": np.int64(3),
        "gamma": 0.9 * one,
        "u_levels": {q: np.arange(3)},
        "min_on": {q: np.int64(2)},
        "integer_horizon": np.int64(2),
        "max_nodes": np.int64(99),
    }
    mpc = qm.LinearMPC(
        ([[0.9]], [[0.1]]), **numbers, Q=1.0, references=np.str_("preview"),
        inputs=[q], outputs=[y], known=[cap, price], E=[[0.0, 0.0]],
        u_bounds={q: (0 * one, cap)}, y_bounds={y: (None, one)}, y_slack={y: one},
        u_target={q: one}, linear={q: price}, constraints={y: ({q: one, y: one}, (0 * one, one))},
    )  # fmt: skip
    for made in (mpc, qm.Controller(mpc)):
        made.save(tmp_path / "mine")
        assert repr(type(made).load(tmp_path / "mine")) == repr(made)


def test_later_releases_read_the_format():
    """``python -m tests.control.test_saving`` has written the file."""
    controller = qm.Controller.load(FOLDER / "saved-3.qpmpc")
    assert controller.mpc.design.plant.known == ("rain", "price")
    assert np.allclose(inputs(controller)[[0, 10, 19], 0], FIRST, rtol=0, atol=1e-9)


#: Inputs of the file's controller.
FIRST = [0.120077159999, -0.46341185293, -0.43811561137]


# Files of other kinds


def test_files_of_other_kinds_are_named(tmp_path):
    mpc = learned()
    qm.Controller(mpc).save(tmp_path / "controller")
    mpc.save(tmp_path / "mpc")
    drawn_mpc(1, 1, 2).save(tmp_path / "qp")
    with pytest.raises(QPError, match=r"controller, a saved Controller, expected a file that QPM"):
        qm.QPMPC.load(tmp_path / "controller")
    with pytest.raises(QPError, match=r"that LinearMPC.save wrote. Controller.load reads it"):
        qm.LinearMPC.load(tmp_path / "controller")
    with pytest.raises(QPError, match=r"mpc, a saved QPMPC, expected a file that Controller.save"):
        qm.Controller.load(tmp_path / "mpc")
    with pytest.raises(QPError, match=r"qp, a QPMPC, expected a saved LinearMPC. QPMPC.load reads"):
        qm.LinearMPC.load(tmp_path / "qp")


@pytest.mark.parametrize(("kind", "part"), [("LinearMPC", "plant"), ("Controller", "horizon")])
def test_a_file_without_a_part_is_named(tmp_path, kind, part):
    made = learned() if kind == "LinearMPC" else qm.Controller(learned())
    made.save(tmp_path / "file")
    content = torch.load(tmp_path / "file")
    del content["design"][part]
    torch.save(content, tmp_path / "file")
    with pytest.raises(QPError, match=rf"^file: got .*/file \(.*{part}.*\), expected a file that"):
        getattr(qm, kind).load(tmp_path / "file")


if __name__ == "__main__":
    qm.Controller(learned()).save(FOLDER / f"saved-{files.VERSION}.qpmpc")
