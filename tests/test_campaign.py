import itertools
from dataclasses import replace

import pytest
import torch

from tests.campaign import families
from tests.campaign.__main__ import load, main
from tests.campaign.families import FAMILIES, Draw, solvable, well_posed
from tests.campaign.outcomes import judge
from tests.campaign.rounding import answers, differences, drawn
from tests.campaign.rounding import main as compare_rounding
from tests.campaign.tally import Tally, alone
from tests.campaign.trained import trained
from torch_qpmpc import Status, solve_qp
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solvers import BACKENDS

CLARABEL = "qpsolvers:clarabel"
pytestmark = pytest.mark.filterwarnings("ignore:Clarabel.rs terminated with status")


@pytest.fixture(autouse=True)
def _little_training(monkeypatch):
    monkeypatch.setattr(families, "trained", lambda: trained(16))


SOLVERS = [f"{name}{start}" for name in (*BACKENDS, CLARABEL) for start in ("", ", warm")]


@pytest.mark.parametrize(
    ("family", "solver"), [*zip(FAMILIES, itertools.cycle(SOLVERS), strict=False)]
)
def test_no_qp_is_called_what_it_is_not_and_a_seed_repeats_it(family, solver):
    """`python -m tests.campaign` draws thousands for each solver."""
    one, other = (FAMILIES[family](Draw(7), 3) for _ in range(2))
    assert torch.equal(one.expected, other.expected)
    for a, b in zip(one.known.qp.tensors(), other.known.qp.tensors(), strict=True):
        assert torch.equal(a.nan_to_num(), b.nan_to_num())
    tally = Tally()
    assert tally.add(one, solver) == []
    assert tally.certified + tally.named + tally.missed == tally.count


@pytest.mark.parametrize(
    ("family", "seed", "count", "solver", "only"),
    [
        # Rounding in hard rows that C implies once looked like a contradiction.
        ("dependent rows", 2000003, 128, "torch", None),
        # A basis of rows whose sine was just above 1e-14 made an exact answer's error 36.
        ("dependent rows", 3, 128, "torch", None),
        # The interior point alone left 3 of these within 1e-7, and refinement none of them.
        ("runaway prediction", 300012, 16, "daqp", None),
        # Errors of the value are infinite for rows that agree up to a solver's tolerance: those of
        # the torch method's answers are large, of the fallback's small.
        ("previews", 0, 128, "daqp", None),
        ("singular H", 1, 32, "torch", None),
        ("infeasible", 6, 128, "daqp", 70),  # rows that contradict each other by 1e-4
        ("infeasible", 4, 16, "daqp", 2),
        ("infeasible", 153, 16, "daqp", 0),  # ... and lead far away to another
        ("unbounded", 42, 16, "daqp", 5),  # a slope of 1 on curvatures of 1 and 0
        ("unbounded", 74, 16, "daqp", 6),
        ("scaled mixed", 108, 16, "daqp", 4),
        ("hopeless plant", 6, 16, "daqp", 0),  # C z = b only 1e8 times as far away as the bounds
    ],
)
def test_what_was_once_not_solved_has_its_status(family, seed, count, solver, only):
    """Of a batch, or ``only`` one of its QPs, alone."""
    case = FAMILIES[family](Draw(seed), count)
    qp, expected = (case.known.qp, case.known.fixed), case.expected
    if only is not None:
        qp, expected = alone(case, only), expected[only]
    solution = solve_qp(*qp, solver=solver, on_failure="mask")
    assert solution.status.tolist() == expected.tolist()


def test_terms_that_cancel_are_the_unit_of_their_value():
    """Far along a flat direction, terms of 5,000 leave a value of 31, which errs by 1e-4."""
    case = FAMILIES["ill conditioned H"](Draw(90004), 15)
    solution = solve_qp(case.known.qp, case.known.fixed, solver="daqp", on_failure="mask")
    assert judge(case, solution).certified.all()
    worse = replace(solution, value=1.01 * solution.value)
    assert judge(case, worse).wrong.all()


def solved(seed: int = 0) -> tuple[families.Case, QPSolution]:
    case = well_posed(Draw(seed), 4)
    return case, solve_qp(case.known.qp, case.known.fixed, solver="daqp")


SPOILERS = {
    "value": lambda s: {"value": s.value + 1e-3 * (1 + s.value.abs())},
    "z": lambda s: {"z": s.z + 0.1},
    "status": lambda s: {"status": torch.full_like(s.status, int(Status.INFEASIBLE))},
    "NaN": lambda s: {"value": s.value * torch.nan},
}


@pytest.mark.parametrize("name", SPOILERS)
def test_the_judge_notices_what_is_wrong(name):
    case, solution = solved()
    assert judge(case, solution).certified.all()
    changed = replace(solution, **SPOILERS[name](solution))
    assert judge(case, changed).wrong.all()


def test_a_solution_of_an_unsolvable_qp_is_wrong_and_giving_up_is_not():
    case, solution = solved()
    hopeless = families.Case(case.known, torch.full_like(case.expected, int(Status.INFEASIBLE)))
    assert judge(hopeless, solution).wrong.all()
    gave_up = torch.full_like(solution.status, int(Status.NOT_CONVERGED))
    tired = replace(solution, status=gave_up)
    assert judge(hopeless, tired).missed.all()
    assert judge(solvable(case.known), tired).missed.all()


def test_the_command_counts_and_writes_its_table(tmp_path, capsys):
    options = ["--count", "12", "--family", "well posed", "unbounded", "--results", str(tmp_path)]
    assert main([*options, "--solver", "daqp, warm", "daqp"]) == 0
    tallies = load(tmp_path)
    assert list(tallies) == ["daqp", "daqp, warm"]
    for of_one in tallies.values():
        assert (of_one["well posed"].certified, of_one["unbounded"].named) == (6, 6)
    printed = capsys.readouterr().out
    assert "| unbounded | 0 | 6 | 0 | 0 |" in printed
    assert "| wrong | 0 | 0 |" in printed


def test_a_unit_in_the_last_place_changes_no_answer():
    """`python -m tests.campaign.rounding` compares thousands, also with other linear algebra."""
    cases, seeds = drawn(1, 0), range(2)
    plain = answers(cases, seeds, nudged=False)
    assert {*plain} == {*cases, *(f"controller {seed}" for seed in seeds)}
    assert list(differences(plain, answers(cases, seeds, nudged=True))) == []
    off = {"controller 1": (plain["controller 1"][0] + 1e-5, "")}
    off |= {"controller 0": (plain["controller 0"][0], "refused")}
    name, *_ = cases
    off[name] = plain[name][0] + 1, plain[name][1]
    assert len(list(differences(plain, plain | off))) == 2 + len(plain[name][0])


@pytest.mark.slow
def test_other_linear_algebra_changes_no_answer(capsys):
    variants = ["this machine", "OpenBLAS: Prescott"]
    assert compare_rounding(["--count=1", "--controllers=2", "--variants", *variants]) == 0
    assert "| OpenBLAS: Prescott, moved data |" in capsys.readouterr().out
