"""Controllers as C: closed loops beside Python's, and faults of signals.

``STEPS=100000 pytest tests/control/test_exporting.py`` compares loops of 100,000 steps.
"""

import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import torch_qpmpc as qm
from tests.campaign.soak import soak
from tests.control.controllers import exported as exported_once
from tests.control.controllers import learned, load
from torch_qpmpc import QPError, SolverError
from torch_qpmpc.control import exporting, observer
from torch_qpmpc.export import comparison, export

STEPS = int(os.environ.get("STEPS", "25"))
A = np.array([[0.9, 0.2, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]])
B = np.array([[0.0, 0.1], [0.5, 0.0], [0.0, 0.4]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SIZES = {"R": 0.1, "dR": 0.2, "u_bounds": (-1.0, 1.0)}


def integrator(**options):
    A, B = [[1.0, 0.1], [0.0, 0.8]], [[0.0], [1.0]]
    design = {"Q": 1.0, "y_bounds": (-2.0, 2.0), "du_bounds": (-0.3, 0.3), **SIZES, **options}
    return qm.LinearMPC((A, B, [[1.0, 0.0]]), 10, **design)


#: Of those that are held, and of the integrator, other tests compare longer and worse loops.
MPCS = {
    "preview": lambda: learned("preview"),
    "blocks": lambda: learned(blocks=[1, 3]),
    "more outputs": lambda: qm.LinearMPC((A, B[:, :1], C), 8, Q=[1.0, 0.5], **SIZES),
    "more inputs": lambda: qm.LinearMPC((A, B, C), 8, Q=[1.0, 0.0], **SIZES, u_target=[0.3, -0.2]),
    "unbounded": lambda: qm.LinearMPC((A, B, C), 5, Q=1.0, R=0.1, disturbances=None),
    "float32": lambda: integrator(y_bounds=None),
}


@pytest.mark.parametrize("name", MPCS)
def test_the_loop_is_that_of_python(tmp_path, name):
    controller, near = qm.Controller(MPCS[name]()), 1e-3 if name == "float32" else 1e-9
    dtype = "float32" if name == "float32" else "float64"
    report = controller.export_c(tmp_path, dtype=dtype)
    assert report.difference < near
    twin = load(report.files, controller, dtype=dtype)
    difference, counts = soak(controller, twin, STEPS, 0, 3, faults=0.0)
    assert difference < near
    assert counts["SOLVED"] == STEPS


def zoned(half: float, **options: Any) -> qm.Controller:
    """Return the controller of y1 whose other inputs hold y2 within ``half``, near y1's."""
    names = {"outputs": ["y1", "y2"], "Q": {"y1": 1.0}, "y_bounds": {"y2": (-half, half)}}
    own = {"R": 0.02, "dR": 0.1, "u_bounds": (-0.5, 0.6), "references": "preview"}
    return qm.Controller(qm.LinearMPC((A, B, C), 8, **{**own, **names, **options}))


def test_a_value_is_as_near_as_the_rows_whose_multipliers_exceed_it(tmp_path, monkeypatch):
    """The target's multipliers cost 2e4 a unit of a row, at a value of 90."""
    monkeypatch.setattr(comparison, "COMPARED", 400)  # as outside of tests
    bounds = {"y_bounds": {"y1": (-1.0, 1.5)}, "u_bounds": ([-1.79, 0.09], [3.98, 2.93])}
    weights = {"Q": {"y1": 0.0}, "R": 0.01, "dR": [0.16565209357659758, 0.10641509996676105]}
    model = [[0.767452706335574]], [[-1.1213164999269107, 2.150466863517873]]
    qm.Controller(qm.LinearMPC(model, 5, **weights, **bounds)).export_c(tmp_path)


@pytest.mark.parametrize("half", [0.2, 20.0])
def test_zones_are_those_of_python_with_gaps_and_in_manual_mode(half):
    controller, twin = exported_once(zoned, missing=True, half=half)
    assert controller.mpc.design.steady.anchors == 1
    difference, counts = soak(controller, twin, 300, 1, 4)
    assert difference < 1e-8
    assert min(counts[x] for x in ("SOLVED", "MISSING", "manual steps")) > 0
    r = np.tile([0.5, np.nan], (9, 1))  # no set-point of y2 is needed
    u, code = twin.step([0.1, 0.2], r)
    assert code == 0
    assert np.abs(controller.step([0.1, 0.2], r) - u).max() < 1e-8


def test_a_set_point_at_a_soft_bound_with_a_large_price_is_certified(tmp_path):
    """The charge of a row's rounding is large beside the value there."""
    sides: dict[str, Any] = {"y_bounds": (18.0, 24.0), "u_bounds": (0.0, 12.0)}
    A = np.eye(4, k=1)
    A[:, 0] = [0.905, -0.0085, 0.066, -0.056]
    model = (A, np.array([[0.25], [0.002], [0.0], [-0.02]]), np.eye(1, 4))
    mpc = qm.LinearMPC(model, 24, Q=1.0, dR=0.1, du_bounds=(-3.0, 3.0), **sides)
    controller = qm.Controller(mpc)
    twin = load(controller.export_c(tmp_path).files, controller)
    x = np.zeros(4)
    for _ in range(30):
        u = controller.step(x[:1], [18.0])
        got, code = twin.step(x[:1], [18.0])
        assert code == 0
        assert np.abs(got - u) < 1e-6
        x = A @ x + model[1] @ (u + 0.6)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Export a controller of the integrator: the controller, its files, and C to be reset."""
    controller = qm.Controller(integrator())
    files = controller.export_c(tmp_path_factory.mktemp("c")).files
    return controller, files, load(files, controller)


def test_an_output_is_missing_from_the_largest_plausible_one_on(exported):
    controller, _, twin = exported
    for share, missing in ((1.0, False), (1.001, True)):
        twin.reset([0.0], [0.0])
        twin.step([0.1], [1.0])
        assert (twin.step(share * controller.max_plausible[0])[1] == 4) == missing


@pytest.mark.parametrize("y", [1e12, 1e16, 1e20])
def test_a_certified_input_keeps_the_bounds_of_moves_where_rounding_is_large(absurd, y):
    twin = absurd
    twin.reset([0.0], [0.0])
    last, codes = np.zeros(1), []
    for k in range(60):
        u, code = twin.step([y if k == 5 else 0.0], [1.0])
        codes.append(code)
        assert np.abs(u - last).max() < 0.3 * (1 + 2e-6)
        assert np.abs(u).max() <= 1.0
        if code:
            assert (u == last).all()
        last = u
    assert y < 1e16 or 1 in codes  # below, another machine's rounding certifies each step


@pytest.fixture(scope="module")
def absurd(tmp_path_factory):
    """Return the integrator's controller in C with estimates that any y may move."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observer, "ABSURD", 1e290)
        controller = qm.Controller(integrator())
    return load(controller.export_c(tmp_path_factory.mktemp("c")).files, controller)


def test_a_reset_takes_the_input_nearest_to_zero_for_one_that_is_not_finite(exported):
    controller, _, twin = exported
    for u in (np.nan, np.inf):
        controller.reset(y=[1.5])
        twin.reset([1.5], [u])
        got, code = twin.step([1.5], [1.0])
        assert code == 0
        assert np.allclose(got, controller.step([1.5], [1.0]), atol=1e-12)


@pytest.mark.parametrize("name", ["math", "2nd"])
def test_a_name_is_refused_as_that_of_a_policy(tmp_path, name, exported):
    with pytest.raises(QPError, match=f"name: got '{name}'.*It begins the names of functions"):
        exported[0].export_c(tmp_path, name=name)
    assert not [*tmp_path.iterdir()]


def test_an_unstable_loop_is_compared_until_its_outputs_are_absurd(tmp_path, monkeypatch):
    monkeypatch.setattr(observer, "ABSURD", 1e3)
    mpc = qm.LinearMPC(([[2.0]], [[0.05]]), 5, Q=1.0, R=0.1, u_bounds=(-1.0, 1.0))
    controller = qm.Controller(mpc)
    report = controller.export_c(tmp_path)
    assert 5 < report.steps < exporting.COMPARED
    assert len(controller.review().findings) == 9


def test_steps_without_a_plan_hold_the_last_input_and_the_estimates_go_on(tmp_path):
    controller = qm.Controller(integrator(y_bounds=(-1.0, 1.0), y_slack=np.inf))
    twin = load(controller.export_c(tmp_path).files, controller)
    for first in (0.0, 3.0):
        controller.reset()
        twin.reset()
        codes, held = [], controller.u
        for k, y in enumerate([first, 0.0, 0.1, 0.2, 3.0, 3.0, 2.5, 0.3, 0.2, 0.1, *[0.0] * 5]):
            r = [0.1 * k] if k % 2 == 0 else None  # the set-point of a step without a plan, too
            u, code = twin.step([y], r)
            codes.append(code)
            assert np.allclose(u, controller.step([y], r), atol=1e-9)
            assert controller.status == code
            assert np.array_equal(controller.u, held if code else controller.u)
            held = controller.u
        assert [codes[0], codes[4], codes[-1]] == [2 * (first > 0), 2, 0]


def test_the_header_names_signals_and_the_report_has_the_size_of_the_state(tmp_path):
    controller = qm.Controller(learned(rate=0.0))
    report = controller.export_c(tmp_path, name="level")
    header = (tmp_path / "level.h").read_text()
    assert "y and r: level [m]" in header
    assert "known: rain, price" in header
    assert f"state {report.state_bytes:,} bytes" in str(report)
    assert report.state_bytes == load(report.files, controller, "level").state_bytes


def test_without_a_compiler_nothing_is_compared(tmp_path, monkeypatch):
    for module in (exporting, export):
        monkeypatch.setattr(module, "compiler", lambda: None)
    report = qm.Controller(integrator()).export_c(tmp_path)
    assert (report.difference, report.state_bytes) == (None, None)
    assert "not compared: no C compiler was found" in str(report)


@pytest.mark.parametrize("name", ["plan", "target"])
def test_the_self_test_finds_a_wrong_table(tmp_path, name, exported):
    controller, files, _ = exported
    files = [Path(shutil.copy(file, tmp_path)) for file in files]
    file = tmp_path / f"policy_{name}.c"
    text = file.read_text()
    start = text.index("U_P[1]")
    file.write_text(text[:start] + re.sub(r"\d\.\d+", "7.7", text[start:], count=2))
    assert load(files, controller).selftest() == 1 + (name == "target")


def test_a_self_test_replays_the_steps_whose_inputs_rounding_hardly_changes(tmp_path):
    """No stable controller stabilises a pole between two zeros: replayed rounding grows."""
    model = ([[4.0, 0.0], [1.0, 0.0]], [[1.0], [0.0]], [[1.0, -3.0]])
    controller = qm.Controller(qm.LinearMPC(model, 10, Q=1.0, R=0.1))
    files = controller.export_c(tmp_path).files
    (replayed,) = re.findall(r"#define EXAMPLES (\d+)", (tmp_path / "policy.c").read_text())
    assert 2 < int(replayed) < exporting.REPLAYED
    assert load(files, controller).selftest() == 0
    file = tmp_path / "policy.c"  # C's own errors in the first steps are larger than rounding
    before, y, after = re.split(r"(?<=EXAMPLE_Y)(.*?;)", file.read_text(), maxsplit=1, flags=re.S)
    y = re.sub(r"\d\.\d+(e[-+]\d+)?", lambda x: repr(float(x[0]) * (1 + 1e-10)), y)
    file.write_text(before + y + after)
    assert load(files, controller).selftest() == 0


@pytest.mark.parametrize(
    ("off", "code", "failed", "match"),
    [
        (0.0, 1, 0, "no plan of C's in step 3 of a loop, where Python has one, expected C that"),
        (1e-3, 0, 0, r"inputs of a loop off by \[.*Python. The cost on the plan has condition"),
        (0.0, 0, 3, r"a failed self-test \(3\), expected C that agrees with Python"),
    ],
)
def test_a_controller_that_disagrees_is_refused(off, code, failed, match, tmp_path, monkeypatch):
    step, count, own = exporting.CompiledController.step, iter(range(1000)), {"raising": False}

    def wrong(*arguments):
        u, found = step(*arguments)
        return (u + off, code) if next(count) == 3 else (u, found)

    selftest = property(lambda _: lambda: failed, lambda *_: None)
    monkeypatch.setattr(exporting.CompiledController, "step", wrong)
    monkeypatch.setattr(exporting.CompiledController, "selftest", selftest, **own)
    with pytest.raises(QPError, match=f"dtype: got 'float64', with {match}"):
        qm.Controller(integrator()).export_c(tmp_path)
    assert not [*tmp_path.iterdir()]


def test_a_loop_without_a_first_plan_is_refused(tmp_path):
    band = {"y_bounds": (10.0, 20.0), "y_slack": np.inf, "u_bounds": (-1.0, 1.0)}
    four = {"u_levels": {"u1": [-1.0, 1.0]}, "min_on": 4, "y_bounds": (-4.0, 4.0)}
    text = "^No input keeps the hard bounds from rest: widen them, "
    for B, own, remedy in ((0.5, band, "or give"), (2.0, band | four, "add levels, shorten")):
        mpc = qm.LinearMPC(([[0.9]], [[B]]), 8, Q=1.0, R=0.1, **own)
        with pytest.raises(SolverError, match=text + remedy):
            qm.Controller(mpc).export_c(tmp_path)


def test_an_absurd_known_signal_leaves_the_estimates_alone(tmp_path):
    controller = qm.Controller(learned())
    twin = load(controller.export_c(tmp_path).files, controller)
    rain, price = np.zeros((2, 5, 2))
    rain[4, 0], price[4, 1] = 1e36, 1e36
    assert twin.step([0.0], [1.0], rain)[1] == 3
    assert twin.step([0.0], [1.0], price)[1] != 3  # it moves no state
    assert twin.step([0.0], [1.0], 0 * rain)[1] == 0
