"""`Controller.redesign`: what is not named stays, for every argument, with two of each signal."""

import inspect
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import torch_qpmpc as qm
from torch_qpmpc import QPError
from torch_qpmpc.control.design import Design

A, B = np.diag([0.9, 0.8]), np.array([[0.1, 0.02], [0.01, 0.2]])
NAMES: Any = {"outputs": ["a", "b"], "inputs": ["p", "q"], "known": ["low", "cap"]}
DESIGN: dict[str, Any] = {
    "Q": {"a": 1.0, "b": 2.0},
    "R": {"p": 0.1, "q": 0.2},
    "dR": {"p": 0.01, "q": 0.02},
    "y_bounds": {"a": (-2.0, 2.0), "b": ("low", 3.0)},
    "u_bounds": {"p": (-1.0, 1.0), "q": (-1.0, "cap")},
    "du_bounds": {"p": (-0.5, 0.5), "q": (-0.4, 0.6)},
    "y_slack": {"a": 50.0, "b": 70.0},
    "u_target": {"p": 0.1, "q": 0.2},
    "constraints": {
        "power": ({"p": 1.0, "q": 0.5}, (None, 1.2)),
        "sum": ({"a": 1.0, "b": 1.0, "p": 0.1}, (-3.0, 3.0), 40.0),
    },
    "terminal_constraints": {
        "end": ({"a": 1.0, "b": -1.0}, (-1.0, 1.0)),
        "top": ({"a": 1.0}, (0.0, 1.0)),
    },
}
FILTER: dict[str, Any] = {
    "noise": {"a": 0.01, "b": 0.02},
    "drift": {"disturbance of a": 0.1, "disturbance of b": 0.2},
}
#: A new value of the first signal of each argument.
CHANGES: dict[str, Any] = {
    "Q": 3.0,
    "R": 0.3,
    "dR": 0.03,
    "y_bounds": (-1.0, None),
    "u_bounds": (-0.5, "cap"),
    "du_bounds": (-0.1, 0.1),
    "y_slack": 90.0,
    "u_target": 0.3,
    "constraints": ({"q": 1.0, "a": 1.0}, (-1.0, 2.0), 30.0),
    "terminal_constraints": ({"a": 1.0, "b": -2.0}, (-2.0, None)),
    "noise": 0.05,
    "drift": 0.5,
}


def made(**changes: Any) -> qm.Controller:
    settings = {**FILTER, **changes}
    design = {**DESIGN, **{x: settings.pop(x) for x in [*settings] if x not in FILTER}}
    return qm.Controller(qm.LinearMPC((A, B), 10, **NAMES, **design), **settings)


def content(controller: qm.Controller) -> dict[str, Any]:
    design = controller.mpc.design
    parts = {x.name: getattr(design, x.name) for x in fields(Design)}
    theta = [x.detach().numpy() for x in controller.mpc.plan.quadratic_program().tensors()]
    parts |= {"L": controller.observer.L, "theta": theta}
    return {name: part for name, part in parts.items() if name not in ("plant", "disturbances")}


def check_alike(one: dict[str, Any], other: dict[str, Any], *but: str) -> None:
    for name in one.keys() - {*but}:
        np.testing.assert_equal(one[name], other[name], err_msg=name)


@pytest.mark.parametrize("argument", CHANGES)
def test_what_a_redesign_does_not_name_stays(argument):
    first = next(iter((DESIGN | FILTER)[argument]))
    for value in (CHANGES[argument], None):
        controller, merged = made(), (DESIGN | FILTER)[argument] | {first: value}
        before = content(controller)
        controller.redesign(**{argument: {first: value}})
        own, fixed = ("L", []) if argument in FILTER else (argument, ["L"])
        check_alike(content(controller), content(made(**{argument: merged})), *fixed)
        check_alike(before, content(controller), own, "limits", "theta")
        with pytest.raises(AssertionError):
            np.testing.assert_equal(before[own], content(controller)[own])


def test_every_argument_is_redesigned_or_refused():
    arguments = {**inspect.signature(qm.LinearMPC).parameters}
    arguments |= {**inspect.signature(qm.Controller).parameters}
    for name in arguments.keys() - CHANGES.keys() - {"violation"}:  # see test_violation.py
        with pytest.raises(TypeError, match=f"redesign got an unexpected keyword argument '{name}"):
            made().redesign(**{name: None})


def test_an_input_without_a_new_limit_keeps_its_own():
    controller = made(y_bounds=None, du_bounds=None)
    ahead = {"low": 0.0, "cap": 0.7}
    controller.reset(y=[0.0, 0.0], u=[0.0, 0.0], known=ahead)
    controller.redesign(u_bounds={"p": (-0.5, 0.5)})
    assert np.allclose(controller.step([0.0, 0.0], [9.0, 30.0], known=ahead), [0.5, 0.7])


def test_weights_of_two_signals_stay_with_both():
    controller = made(Q=[[1.0, 0.5], [0.5, 2.0]])
    controller.redesign(Q={"a": 3.0})
    assert controller.mpc.design.Q.tolist() == [[3.0, 0.5], [0.5, 2.0]]
    controller.redesign(Q={"a": None})
    assert controller.mpc.design.Q.tolist() == [[0.0, 0.0], [0.0, 2.0]]


def test_a_price_that_is_not_named_is_the_default():
    """It used to be zero, which left out the bounds of the output."""
    design, default = (made(y_slack=x).mpc.design for x in ({"a": 50.0}, None))
    assert design.slack.tolist() == [50.0, default.slack[1]]
    assert len(design.bounded[0]) == len(design.plant.outputs)


def test_default_prices_follow_the_weights_and_bounds():
    """A bound priced for weights of one gave way to those of 1e6."""
    controller, new = made(y_slack={"a": 50.0}), {"Q": {"b": 1e6}, "y_bounds": {"b": (0.0, 9.0)}}
    controller.redesign(**new)
    merged = {x: {**DESIGN[x], **own} for x, own in new.items()}
    expected = made(y_slack={"a": 50.0}, **merged).mpc.design.slack
    assert controller.mpc.design.slack.tolist() == expected.tolist()
    assert expected[1] > 1e6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Q": {"p": 1.0}}, "Q: got 'p', expected names among a, b"),
        ({"Q": {"a": "high"}}, r"Q: got \[.*'high'.*\], expected a tensor, or what"),
        ({"u_bounds": {"a": (0, 1)}}, "u_bounds: got 'a', expected names among p, q"),
        ({"u_bounds": {"p": (2.0, "cap", 1.0)}}, "u_bounds: got .* expected pairs"),
        ({"u_bounds": {"p": (0.0, "top")}}, "u_bounds: got 'top', expected numbers or known"),
        ({"Q": {"a": -1.0}}, "Q: got smallest eigenvalue -1, expected a positive semidefinite"),
        ({"noise": {"b": 0.0}}, "noise: got 0.01 of a, 0 of b, expected a standard deviation"),
        ({"drift": {"a": 0.1}}, "drift: got 'a', expected names among disturbance of a, dist"),
    ],
)
def test_a_wrong_change_is_named_and_changes_nothing(changes, message):
    controller = made()
    before = content(controller)
    with pytest.raises(QPError, match=f"^{message}"):
        controller.redesign(**changes)
    check_alike(before, content(controller))
