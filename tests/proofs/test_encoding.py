"""The encoding has one solution for each p: the policy."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch

from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.export.tables import make_tables
from torch_qpmpc.proofs import Polytope
from torch_qpmpc.proofs.encoding import encode
from torch_qpmpc.proofs.program import Program

A, B = [[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]]
BOX = Polytope.box([-1.2, -0.8], [1.2, 0.8])
CASES: dict[str, dict[str, Any]] = {
    "actions": {"action_bounds": ([-0.5], [1.0])},
    "soft states": {
        "state_bounds": ([-1.0, -0.5], [1.0, 0.5]),
        "state_slack": 2.0,
        "action_bounds": ([-1.0], [1.0]),
    },
    "one side": {"state_bounds": ([-np.inf, -0.3], [np.inf, np.inf])},
    "no rows": {},
    "equal bounds": {"state_bounds": ([-np.inf, 0.1], [np.inf, 0.1]), "state_slack": 1.0},
}


def scheme(structure: str = "tied", **bounds: Any) -> QPMPC:
    mpc = QPMPC.from_model(
        A, B, 4, stage_weight=[1.0, 0.5, 0.1], structure=structure, solver="daqp", **bounds
    )
    if structure == "free":
        with torch.no_grad():
            mpc.C.add_(0.02 * torch.randn(mpc.C.shape, generator=torch.Generator().manual_seed(0)))
    return mpc


@pytest.mark.parametrize(
    ("case", "structure"), [*zip(CASES, itertools.cycle(("tied", "free")), strict=False)]
)
def test_the_encoding_has_the_policy_as_its_only_solution(case, structure):
    mpc = scheme(structure, **CASES[case])
    tables = make_tables(mpc)
    generator = np.random.default_rng(1)
    states = np.concatenate((generator.uniform(BOX.lower, BOX.upper, (1, 2)), np.zeros((1, 2))))
    for state in states:
        program = Program()
        p = program.add(state, state)
        u = encode(program, tables, p, BOX.vertices())
        ends = [program.maximise(u.times(sign * np.eye(1))) for sign in (1.0, -1.0)]
        policy = mpc.policy(torch.tensor(state)).detach().numpy()
        assert ends[0].bound == pytest.approx(policy[0], abs=1e-5)
        assert -ends[1].bound == pytest.approx(policy[0], abs=1e-5)


def hard(state_bounds) -> QPMPC:
    return scheme(state_bounds=state_bounds, state_slack=np.inf, action_bounds=([-1.0], [1.0]))


def test_a_set_with_infeasible_states_is_an_error():
    mpc = hard(([-1.0, -0.5], [1.0, 0.5]))
    program = Program()
    p = program.add(BOX.lower, BOX.upper)
    with pytest.raises(QPError, match="the hard rows leave no plan with slack"):
        encode(program, make_tables(mpc), p, BOX.vertices())


def test_hard_states_with_slack_are_encoded():
    mpc = hard(([-3.0, -2.0], [3.0, 2.0]))
    state = np.array([1.2, 0.8])
    program = Program()
    u = encode(program, make_tables(mpc), program.add(state, state), BOX.vertices())
    policy = mpc.policy(torch.tensor(state)).item()
    assert program.maximise(u).bound == pytest.approx(policy, abs=1e-5)
