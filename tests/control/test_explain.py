"""`Controller.explain`: what limits a plan, and what it predicts, against QPs solved apart."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import torch_qpmpc as qm
from tests.refused import refused
from torch_qpmpc.control.state_space import read_model

A, B = np.array([[0.9, 0.05], [0.0, 0.8]]), np.array([[0.5], [0.2]])
KNOWN = {"d": np.linspace(1.0, 2.0, 9), "most": np.linspace(1.95, 1.2, 9)}


def controller(**options) -> qm.Controller:
    names: Any = {"inputs": ["q"], "outputs": ["T", "h"], "known": ["d", "most"]}
    plant = read_model((A, B), E=[[0.1, 0.0], [0.0, 0.0]], **names)
    plant = replace(plant, units={"T": "degC", "q": "kW"})
    design = {
        "Q": {"T": 1.0},
        "dR": 0.1,
        "u_bounds": {"q": (0.0, "most")},
        "du_bounds": (-0.7, 0.7),
        "y_bounds": {"T": (-1.0, 4.5), "h": (-2.0, 1.5)},
        "y_slack": {"T": 3.0, "h": 1.0},
    }
    return qm.Controller(qm.LinearMPC(plant, 8, **{**design, **options}))


def stepped(r: float = 8.0, **options) -> qm.Controller:
    made = controller(**options)
    made.reset(y=[2.0, 0.3], u=[0.5], known={"d": 1.0, "most": 2.0})
    made.step([2.0, 0.3], [r, 0.0], known=KNOWN)
    return made


def test_prices_are_the_cost_s_slopes():
    """The QP's value with a bound's row moved in those steps, by central differences."""
    made = stepped()
    limits, h = made.explain().limits, 1e-5
    qp = made.mpc.plan.quadratic_program()
    assert {x.signal for x in limits} >= {"q", "move of q"}
    rows = {"T": 0, "h": 1, "q": 2, "move of q": 4}  # q has a row for each side
    for limit in limits:
        side, values = "upper" if "upper" in limit.text else "lower", []
        for by in (h, -h):
            sides = {"lower": qp.lb.clone(), "upper": qp.ub.clone()}
            columns = sides[side][-8 * 5 - 2 :]
            own = columns[:-2].view(8, 5)
            own[:, rows[limit.signal] + (limit.signal == "q")] += by
            if limit.signal in "Th":
                columns[-2 + rows[limit.signal]] += by
            moved = replace(qp, lb=sides["lower"], ub=sides["upper"])
            values.append(qm.solve_qp(moved, made.p, solver="daqp").value.item())
        slope = abs(values[0] - values[1]) / (2 * h)
        assert limit.price == pytest.approx(slope, rel=1e-4), limit


def test_the_plan_is_what_the_controller_does_if_the_model_is_right():
    made = stepped()
    told, x = made.explain(), np.array([2.0, 0.3])
    e = made.observer.at_rest(np.array([0.5]), np.array([1.0, 2.0]), x)
    for k in range(8):
        e = made.observer.predicted(e, told.u[k], np.array([KNOWN["d"][k], 0.0]))
        assert np.allclose(told.y[k], made.observer.H @ e)
    assert (told.u[:, 0] <= KNOWN["most"][:8] + 1e-9).all()
    assert (told.u[0] == made.u).all()


def test_an_operator_reads_names_units_and_what_to_do():
    text = str(stepped().explain())
    assert text.startswith(
        "SOLVED: All outputs are measured, and the input is optimal.\nT 2 degC, "
    )
    assert "\nq is at its upper bound " in text
    assert " kW in steps " in text
    assert "1 kW more would save " in text
    assert "\ndisturbance of T " in text
    assert "Set T to 4.5, not 8, or widen y_bounds of T" in text
    assert "No bound holds the plan back." in str(stepped(r=1.9, y_bounds=None).explain())


def test_prices_of_small_signals_are_by_a_unit_of_their_size():
    mpc = qm.LinearMPC(
        (A, 1e6 * B), 8, Q=[1.0, 0.0], dR=1e10, u_bounds=(-2e-6, 2e-6), du_bounds=(-1e-6, 1e-6)
    )
    made = qm.Controller(mpc)
    made.step([0.0, 0.0], [2.0, 0.0])
    (limit,) = (x for x in made.explain().limits if x.signal == "move of u1")
    saved = f"1e-06 more would save {1e-6 * limit.price:.3g} of the cost."
    assert limit.text == f"move of u1 is at its upper bound 1e-06 in step 0: {saved}"


def test_a_violated_soft_bound_is_told_by_how_much():
    made = controller()
    made.reset(y=[6.0, 0.3], u=[0.5], known={"d": 1.0, "most": 2.0})
    made.step([6.0, 0.3], [4.0, 0.0], known=KNOWN)
    (limit,) = (x for x in made.explain().limits if x.signal == "T")
    assert limit.violation == pytest.approx(made.explain().y[0, 0] - 4.5, rel=1e-3)
    assert f"violated by up to {limit.violation:.3g}" in limit.text


def test_the_plan_is_drawn():
    made = stepped()
    axes = made.explain().plot().axes
    assert [x.get_ylabel() for x in axes][:2] == ["T [degC]", "h"]
    assert np.shape(axes[0].lines[0].get_ydata()) == (9,)


def test_faulty_steps_are_told_in_words():
    made = stepped()
    made.step({"T": None, "h": 0.3}, known=KNOWN)
    assert "MISSING: Predictions stand for missing outputs" in str(made.explain())
    assert "\nT missing, set-point 8" in str(made.explain())
    made.step([2.0, 0.3], [np.nan, 0.0], known=KNOWN)
    told = made.explain()
    assert "INVALID: A set-point, known signal or first output is invalid" in str(told)
    assert (told.u == made.u).all()
    assert np.isfinite(told.y).all(), "what the held input leads to"
    assert told.limits == ()
    made.step([2.0, 0.3], known={"d": np.nan, "most": 2.0})
    assert np.isfinite(made.explain().y).all()
    made.explain().plot()
    started = controller()
    started.step({"T": None, "h": 0.3}, [8.0, 0.0], known=KNOWN)
    assert np.isnan(started.explain().y).all()
    started.explain().plot()


NOTHING = "controller: got no step since the last change, expected a"


@refused(
    (lambda c: c.reset(), NOTHING),
    (lambda c: c.redesign(Q=2.0), NOTHING),
    (lambda c: c.observe([2.0, 0.3], [0.5], known={"d": 1.0, "most": 2.0}), NOTHING),
)
def test_without_a_step_there_is_nothing_to_explain(change):
    change(made := stepped())
    made.explain()


def test_hard_bounds_are_looked_for_without_a_plan_only(monkeypatch):
    monkeypatch.delattr("torch_qpmpc.control.explain.hard_rows")
    assert "hard bounds" not in stepped().explain().reach


def test_hard_bounds_without_a_plan_are_named():
    made = controller(y_bounds={"T": (-1.0, 4.5)}, y_slack={"T": np.inf})
    made.reset(y=[9.0, 0.0], u=[0.0], known={"d": 1.0, "most": 2.0})
    made.step([9.0, 0.0], [1.0, 0.0], known=KNOWN)
    assert made.status.name == "INFEASIBLE"
    assert "holds T outside the hard bounds. Give T a finite y_slack." in str(made.explain())


def test_inputs_whose_bounds_contradict_are_told_of_them_alone():
    limited = {"known": ["most"], "u_bounds": {"u1": (2.0, "most")}}
    made = qm.Controller(qm.LinearMPC(([[0.9]], [[0.5]]), 5, Q=1.0, dR=0.1, **limited))
    made.step([0.0], [1.0], known=[1.0])
    *_, last = str(made.explain()).splitlines()
    assert last == "The plant rests with no input within its bounds. Widen u_bounds."


def test_a_plan_of_one_stage_ends_in_one_step():
    made = qm.Controller(qm.LinearMPC(([[0.9]], [[0.5]]), 1, Q=1.0, dR=0.1))
    made.step([0.0], [1.0])
    assert ", set-point 1, in 1 step " in str(made.explain())


def test_what_holds_a_free_input_is_said():
    for R, held in ((0.1, "at rest"), (None, "no R holds it")):
        mpc = qm.LinearMPC(([[0.9]], [[0.2, 0.1]]), 5, Q=1.0, R=R, dR=0.1, u_target={"u1": 0.5})
        made = qm.Controller(mpc)
        made.step([0.0], [1.0])
        assert f"free: {held} near 0.5" in str(made.explain())


@pytest.mark.parametrize("references", ["held", "preview"])
def test_the_set_point_in_force_is_judged(references):
    """With held set-points the first row, else the last of the horizon."""
    mpc = qm.LinearMPC(
        ([[0.9]], [[0.5]]), 5, Q=1.0, dR=0.1, u_bounds=(-1, 1), references=references
    )
    made = qm.Controller(mpc)
    rows = np.array([[0.0], *[[100.0]] * 5])
    faults = made.review(r=rows).faults
    made.step([0.0], rows)
    assert any("not 100" in fault.remedy for fault in faults) == (references == "preview")
    assert ("not 100" in made.explain().reach) == (references == "preview")
