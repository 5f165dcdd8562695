"""The bounds of a scheme: their rows, and messages."""

import torch

from tests.refused import refused
from torch_qpmpc import Bounds, Layout, Scheme


def test_rows_are_hard_or_have_a_price():
    bounds = Bounds(
        state_bounds=([-1.0, -2.0], [1.0, 2.0]),
        action_bounds=([-3.0], [3.0]),
        constraints=([[1.0, 0.0, 1.0]], [0.0], [4.0]),
        state_slack=[7.0, torch.inf],
    )
    scheme = Scheme(Layout(2, 1, horizon=1), bounds=bounds)
    assert (scheme.layout.n_mixed, scheme.layout.n_terminal) == (1, 0)
    theta = bounds.rows(scheme.layout)
    assert theta["ub"].tolist() == [1, 2, 3, 1, 2, 4]
    assert theta["lb"].tolist() == [-1, -2, -3, -1, -2, 0]
    assert theta["w"].tolist() == [7, torch.inf, torch.inf, 7, torch.inf, 100]
    assert theta["G"][-1].tolist() == [1, 0, 1, 0, 0], "z = [x_0, u_0, x_1]"


def test_each_row_of_D_and_D_f_may_have_its_own_price():
    rows = ([[1.0, 0.0], [0.0, 1.0]], [-1.0] * 2, [1.0] * 2)
    bounds = Bounds(
        constraints=rows,
        terminal_constraints=([[1.0]], [-1.0], [1.0]),
        constraint_slack=[2.0, torch.inf, 3.0],
    )
    w = bounds.rows(Scheme(Layout(1, 1, horizon=2), bounds=bounds).layout)["w"]
    assert w[5:].tolist() == [2, torch.inf, 2, torch.inf, 3]


def test_rows_that_hold_through_a_block_are_those_of_actions_or_named():
    rows = ([[1.0, 0.0], [0.0, 1.0]], [-1.0] * 2, [1.0] * 2)
    scheme = Scheme(Layout(1, 1, horizon=2), bounds=Bounds(constraints=rows))
    assert scheme.of_actions.tolist() == [False, True]
    named = Scheme(Layout(1, 1, horizon=2), bounds=Bounds(constraints=rows, held=[True, True]))
    assert named.of_actions.tolist() == [True, True]


@refused(
    ({"held": [True]}, r"held: got shape \(1,\), expected \(0,\): one entry per row"),
    ({"state_bounds": 5.0}, r"state_bounds: got 5.0, expected the pair \(lower, upper\)"),
    ({"state_bounds": ([1.0], [1.0, 2.0])}, r"state_bounds: got shapes \(1,\) and \(2,\), expecte"),
    ({"action_bounds": (-1.0, 1.0)}, r"action_bounds: got shape \(\), expected a vector on ea"),
    ({"action_bounds": ([torch.nan], [1.0])}, "action_bounds: got NaN, expected no NaN; inf f"),
    ({"action_bounds": ([torch.inf], [torch.inf])}, "action_bounds: .* lower bounds below inf"),
    ({"action_bounds": ([-torch.inf], [-torch.inf])}, "action_bounds: .* upper bounds above"),
    ({"state_bounds": ([-1.0, 2.0], [1.0, 1.5])}, "state_bounds: got lower 2 > upper 1.5 at entry"),
    ({"constraints": 1.0}, r"constraints: got 1.0, expected the triple \(D, lower, upper\)"),
    ({"constraints": ([1.0, 1.0], [0.0], [1.0])}, r"constraints: got D of shape \(2,\), expected"),
    (
        {"terminal_constraints": (torch.ones(1, 3), [1.0], [0.0])},
        "terminal_constraints, bounds: got lower 1 > upper 0 at entry 0, expected lower <=",
    ),
    ({"constraint_slack": [-1.0]}, r"constraint_slack: got \[-1.0\], expected a non-negati"),
    ({"state_slack": None}, "state_slack: got None, expected a non-negative weight, or inf"),
)
def test_bad_arguments_are_named(arguments):
    Bounds(**arguments)


@refused(
    ({"state_bounds": ([-1.0], [1.0])}, r"state_bounds: got shape \(1,\), expected shape \(2,\)"),
    ({"constraints": (torch.ones(2, 2), [0.0] * 2, [1.0] * 2)}, r"constraints: got D of shape \(2"),
    ({"constraint_slack": [1.0]}, r"constraint_slack: got shape \(1,\), expected shape"),
)
def test_a_scheme_refuses_bounds_of_other_sizes(arguments):
    Scheme(Layout(2, 1, 3), bounds=Bounds(**arguments))
