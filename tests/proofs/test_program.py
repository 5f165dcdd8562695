"""The growing mixed-integer program, on small programs with known optima."""

import numpy as np
import pytest
from scipy.optimize import OptimizeResult

from torch_qpmpc import SolverError
from torch_qpmpc.proofs import program as module
from torch_qpmpc.proofs.program import Affine, Program


def knapsack() -> tuple[Program, Affine]:
    """Weights 3, 4, 5 of at most 8, values 4, 5, 7: the best is 3 and 5, of value 11."""
    program = Program()
    x = program.add(np.zeros(3), np.ones(3), binary=True)
    program.constrain(x.times(np.array([[3.0, 4.0, 5.0]])), upper=8.0)
    return program, x.times(np.array([[4.0, 5.0, 7.0]]))


def test_binaries_are_whole_and_relaxed_ones_are_not():
    program, objective = knapsack()
    assert program.binaries == 3
    best = program.maximise(objective)
    assert best.value == pytest.approx(11)
    assert best.bound == pytest.approx(11)
    assert np.allclose(best.x, [1, 0, 1])
    assert program.maximise(objective, relaxed=True).bound == pytest.approx(11.0)


def test_a_program_that_presolve_spoils_is_solved_without_it(monkeypatch):
    unknown = OptimizeResult(status=4, fun=0.0, message="model_status is Unknown")
    solve, presolved = module.milp, []

    def milp(*arguments, options, **others):
        presolved.append(options["presolve"])
        return unknown if options["presolve"] else solve(*arguments, options=options, **others)

    monkeypatch.setattr(module, "milp", milp)
    program, objective = knapsack()
    assert program.maximise(objective).bound == pytest.approx(11)
    assert presolved == [True, False]
    monkeypatch.setattr(module, "milp", lambda *arguments, **others: unknown)
    with pytest.raises(SolverError, match="model_status is Unknown"):
        program.maximise(objective)


def test_an_infeasible_program_is_an_error():
    program, objective = knapsack()
    program.constrain(objective, lower=12.0)
    with pytest.raises(SolverError, match="HiGHS gave no bound of the worst case"):
        program.maximise(objective)
