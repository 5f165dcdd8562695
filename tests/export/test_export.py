"""`export_c`: its files, its report, and its errors."""

import datetime
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
from tests.exported import SCHEMES, house, rates, read, tied
from tests.refused import refused
from torch_qpmpc import QPMPC, QPError, Status, export_c
from torch_qpmpc.export import comparison
from torch_qpmpc.export import export as module
from torch_qpmpc.export.comparison import draw
from torch_qpmpc.export.library import Library, compiler
from torch_qpmpc.export.tables import make_tables
from torch_qpmpc.export.writer import comment

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler")


@needs_compiler
def test_the_report_has_sizes_and_agreement(tmp_path):
    mpc = SCHEMES["point mass"]()
    export = export_c(mpc, tmp_path / "deep" / "folder", name="mass")
    assert [file.name for file in export.files] == ["mass.h", "mass.c"]
    assert all(file.exists() for file in export.files)
    assert (export.n_p, export.n_u, export.rows, export.variables) == (4, 2, 60, 20)
    agreement = export.agreement
    assert agreement.u < 1e-8
    assert agreement.value < 1e-8
    assert agreement.unsolved == 0
    assert (agreement.states, agreement.solved, agreement.infeasible) == (40, 40, 0)
    assert "where solved (40); 0 infeasible, 0 unsolved" in str(export)
    assert 20 < agreement.iterations < export.max_iterations == 1300
    assert export.state_bytes == read(tmp_path / "deep/folder", "mass").state_bytes
    assert f"state {export.state_bytes:,} bytes" in str(export)
    assert "at 40 states: actions within" in str(export)


@needs_compiler
def test_float32_is_measured(tmp_path):
    export = export_c(tied(), tmp_path, dtype="float32", name="single")
    assert 1e-8 < export.agreement.u < 1e-3
    assert "typedef float single_real;" in export.files[0].read_text()
    library = read(tmp_path, "single", "float32")
    assert library.state_bytes == export.state_bytes


@needs_compiler
def test_float32_is_refused_where_the_self_test_fails(tmp_path):
    match = r"dtype: got 'float32', with (a failed self-test|.* not certified).*Export float64"
    with pytest.raises(QPError, match=match):
        export_c(ill_conditioned(), tmp_path, dtype="float32")
    assert not [*tmp_path.iterdir()]
    export_c(ill_conditioned(), tmp_path)


def ill_conditioned() -> QPMPC:
    """Make an unstable scheme whose predictions grow by two orders of magnitude."""
    return QPMPC.from_model(
        [[1.1, 1.0], [0.0, 1.1]],
        [[0.0], [1.0]],
        20,
        stage_weight=[1.0, 1.0, 1e-4],
        action_bounds=([-1.0], [1.0]),
        state_bounds=([-1.0, -1.0], [1.0, 1.0]),
        solver="daqp",
    )


@needs_compiler
def test_the_head_names_version_date_layout_and_hash(tmp_path):
    mpc = rates()
    head = export_c(mpc, tmp_path).files[1].read_text().partition("*/\n")[0]
    today = datetime.date.today().isoformat()
    assert f"torch_qpmpc {qm.__version__} on {today}" in head
    assert "p[0 .. 2]: x_0\n   u[0]: u_0" in head
    same = export_c(mpc, tmp_path / "again")
    assert same.digest in head
    with torch.no_grad():
        mpc.c += 1e-12
    assert export_c(mpc, tmp_path / "other").digest != same.digest


@needs_compiler
def test_previews_are_in_the_head(tmp_path):
    head = export_c(house(2), tmp_path).files[0].read_text()
    assert "p[6 .. 8]: d_2\n   p[9]: x_0" in head


@refused(
    ({"dtype": "float16"}, "dtype: got 'float16', expected one of float64, float32"),
    ({"name": "2nd"}, "name: got '2nd', expected a C identifier. It begins the names"),
    ({"name": 3}, "name: got 3, expected a C identifier"),
    ({"name": "Math"}, "name: got 'Math', whose .h is a standard header, expected another"),
    ({"max_iterations": 0}, "max_iterations: got 0, expected a whole number >= 1"),
)
def test_bad_arguments_are_refused(options, tmp_path):
    export_c(rates(), tmp_path, **options)


def test_a_qp_without_solutions_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(comparison, "COMPARED", 5)
    mpc = QPMPC.of(1, 1, 2, A=[[1.0]], B=[[1.0]], stage_weight=[1.0, 1.0])
    solve = comparison.reference

    def unsolved(*arguments):
        found = solve(*arguments)
        found.status[:] = 3
        return found

    monkeypatch.setattr(comparison, "reference", unsolved)
    match = "mpc: got no solution of its QP at 5 states, expected a QP that a solver solves"
    with pytest.raises(QPError, match=match):
        export_c(mpc, tmp_path)


def test_a_large_qp_is_compared_at_fewer_states(tmp_path, monkeypatch):
    monkeypatch.setattr(comparison, "LARGE", 4)
    monkeypatch.setattr(comparison, "LEAST", 15)
    agreement = export_c(tied(), tmp_path).agreement
    assert agreement.states == comparison.LEAST
    assert agreement.solved >= comparison.LEAST // 2
    assert agreement.u < 1e-8
    assert agreement.value < 1e-8


def shifted(**options) -> QPMPC:
    """Make a scheme with two actions in percent, far from 0, and hard limits of their changes."""
    one, none = torch.eye(2), torch.zeros(2, 2)
    return QPMPC.from_model(
        torch.block_diag(0.9 * one, none),
        torch.cat((0.1 * one, one)),
        10,
        stage_weight=[1.0, 1.0, 0.0, 0.0, 0.1, 0.1],
        action_bounds=([40.0] * 2, [60.0] * 2),
        constraints=(torch.cat((none, -one, one), 1), [-1.0] * 2, [1.0] * 2),
        constraint_slack=torch.inf,
        on_failure="mask",
        **options,
    )


def test_states_are_drawn_about_a_feasible_one(tmp_path):
    mpc = shifted(state_bounds=([49.0] * 2 + [-torch.inf] * 2, [51.0] * 2 + [torch.inf] * 2))
    tables = make_tables(mpc)
    p, exact = comparison.states(mpc, tables, "float64")
    assert mpc.solve(torch.tensor(tables.centre)).solved
    assert mpc.solve(torch.tensor(draw(tables, 100))).solved.sum() > 20
    last = p[exact.status == Status.SOLVED, 2:4]
    assert len(last) > 20
    assert ((last > 39 - 1e-6) & (last < 61 + 1e-6)).all()
    export = export_c(mpc, tmp_path)
    kinds = (tmp_path / "policy.c").read_text().split("self-test: ")[1].split(". */")[0]
    assert {*kinds.split(", ")} == {"at bounds", "saturated", "infeasible"}  # 0 is out of bounds
    if export.agreement is not None:
        agreement = export.agreement
        assert agreement.states == 40
        assert agreement.solved + agreement.infeasible >= 39  # by rounding one is at the edge
        assert agreement.solved > 20
        assert agreement.infeasible > 0
        assert 0 < agreement.u < 1e-8


def test_infeasible_states_are_moved_to_the_edge_of_the_feasible_ones_at_once():
    moves: Any = {"u_bounds": (-1.0, 1.0), "du_bounds": (-0.2, 0.2), "y_bounds": (-1.0, 1.0)}
    A, B = [[0.9, 0.3], [-0.2, 0.7]], [[0.4, 0.1], [0.2, 0.5]]
    mpc = qm.LinearMPC((A, B), 5, Q=1.0, dR=0.1, **moves).plan
    tables = make_tables(mpc)
    with qm.SolveLog() as log:
        p, exact = comparison.states(mpc, tables, "float64")
    assert log.solves < 1.2 * len(p)
    solved = exact.status == Status.SOLVED
    assert solved.sum() > len(p) / 2
    moved = solved & (np.abs(p - draw(tables, len(p))) > 1e-9).any(1)
    assert moved.sum() > len(p) / 4
    assert (moved[::4] == 0).all()
    further = comparison.reference(mpc, 2 * p[moved] - tables.centre)
    assert (further.status == Status.INFEASIBLE).all()


@pytest.mark.parametrize(("large", "error"), [(comparison.LARGE, 1e-7), (4, 0.0)])
def test_a_loose_solution_is_replaced_or_found_from_its_active_set(monkeypatch, large, error):
    monkeypatch.setattr(comparison, "LARGE", large)
    mpc = shifted()
    p = draw(make_tables(mpc), 12)
    best = comparison.reference(mpc, p)
    solved = np.flatnonzero(best.status == Status.SOLVED)
    assert len(solved) > 5
    loose = best._replace(z=0 * best.z, lam=0 * best.lam, value_error=best.value_error + error)
    got = comparison.sharpen(mpc, p, loose, solved)
    expected = comparison.actions(mpc, best)[solved]
    np.testing.assert_allclose(comparison.actions(mpc, got)[solved], expected, atol=1e-7)


@pytest.mark.parametrize("ends", [(-0.5, 3e9), (-2e8, 5e7), (-4e16, 0.5), (0.0, 7e11)])
def test_a_bound_that_cannot_act_draws_the_states_of_none(ends, tmp_path):
    def bounded(ends: tuple[float, float]) -> QPMPC:
        options = {"stage_weight": [1.0, 0.1, 0.1], "action_bounds": ([-1.0], [1.0])}
        sides = {"state_bounds": ([ends[0], -torch.inf], [ends[1], torch.inf])}
        A, B = [[0.9, 0.2], [0.0, 0.8]], [[0.1], [0.5]]
        return QPMPC.from_model(A, B, 8, **options, **sides, state_slack=100.0)

    mpc, near = bounded(ends), [x if abs(x) < 1e6 else np.copysign(np.inf, x) for x in ends]
    sizes = [np.abs(draw(make_tables(x), 50)).max(0) for x in (mpc, bounded((near[0], near[1])))]
    np.testing.assert_allclose(*sizes, rtol=0.1)
    export = export_c(mpc, tmp_path)
    if export.agreement is not None:
        assert export.agreement.u < 1e-8


def test_hard_rows_that_contradict_each_other_are_refused(tmp_path):
    bounds = {"state_bounds": ([-1.0], [1.0]), "state_slack": torch.inf}
    mpc = QPMPC.from_model([[0.0]], [[0.0]], 2, stage_weight=[1.0, 1.0], offset=[3.0], **bounds)
    match = "mpc: got no solution of its QP at 40 states, .* hard rows may contradict .* slack"
    with pytest.raises(QPError, match=match):
        export_c(mpc, tmp_path)


@needs_compiler
@pytest.mark.parametrize(
    ("part", "at", "by", "match"),
    [
        (
            "codes",
            slice(None),
            1,
            "max_iterations: got 3, with none of 40 states solved, expected ",
        ),
        ("u", 3, 1e-3, r"dtype: got 'float64', with an action off by \d\.\de-0\d of its size"),
    ],
)
def test_a_limit_that_solves_nothing_and_another_action_at_any_state_are_refused(
    part, at, by, match, tmp_path, monkeypatch
):
    steps = Library.steps

    def off(self, *arguments):
        found = steps(self, *arguments)
        getattr(found, part)[at] += by
        return found

    monkeypatch.setattr(Library, "steps", off)
    with pytest.raises(QPError, match=f"^{match}"):
        export_c(tied(), tmp_path, max_iterations=3 if part == "codes" else None)


@needs_compiler
@pytest.mark.parametrize("name", ["POLICY", "u", "EXAMPLE", "int_"])
def test_any_identifier_is_a_name(name, tmp_path):
    export_c(tied(3), tmp_path, name=name)
    text = (tmp_path / f"{name}.h").read_text()
    assert f"int {name}_step({name}_state *state" in text
    assert f"#ifndef {name.upper()}_H" in text


@needs_compiler
@pytest.mark.parametrize("language", ["cc -std=c99", "g++ -x c++"])
def test_no_label_ends_its_comment_or_the_line(language, tmp_path):
    command = language.split()
    if shutil.which(command[0]) is None:
        pytest.skip(f"no {command[0]}")
    bad = [
        "a */ int b;",
        "/* c",
        "*\\\n/ d",
        "*??/\n/ e",
        "f \\",
        "g\r*/",
        "\u202eh",
        "\ud800",
        "**//",
    ]
    source = tmp_path / "labels.c"
    source.write_text(comment(["%\\", *bad]) + "\nint used;\n", encoding="utf-8")
    flags = ["-trigraphs", "-Wall", "-Wextra", "-Werror", "-c", "-o", str(tmp_path / "labels.o")]
    command += [*flags, str(source)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_without_a_compiler_float64_is_written_and_float32_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "compiler", lambda: None)
    export = export_c(tied(), tmp_path)
    assert export.agreement is None
    assert "not compared with a solver: no C compiler was found" in str(export)
    with pytest.raises(QPError, match="dtype: got 'float32' without a C compiler to test it"):
        export_c(tied(), tmp_path, dtype="float32")


@needs_compiler
def test_a_failed_self_test_of_float64_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "Library", lambda *_: Failing(*_))
    match = r"dtype: got 'float64', with a failed self-test at state 1 \(interior.*condition"
    with pytest.raises(QPError, match=match):
        export_c(tied(), tmp_path)


class Failing(Library):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.selftest = lambda: 1


@needs_compiler
def test_two_policies_link_into_one_program(tmp_path):
    export_c(tied(), tmp_path, name="one")
    export_c(rates(), tmp_path, name="two")
    main = '#include "one.h"\n#include "two.h"\nint main(void)\n'
    main += "{ return one_selftest() + two_selftest(); }\n"
    (tmp_path / "main.c").write_text(main)
    files = [str(tmp_path / f"{name}.c") for name in ("main", "one", "two")]
    command = ["cc", "-std=c99", *files, "-o", str(tmp_path / "main")]
    subprocess.run(command, check=True, capture_output=True)
    subprocess.run([str(tmp_path / "main")], check=True)


@needs_compiler
def test_entries_with_one_value_only_keep_it_in_the_examples(tmp_path):
    model = ([[0.9]], [[0.5]])
    constant = qm.LinearMPC(model, 4, Q=1.0, R=0.1, u_bounds=(-1.0, 1.0), solver="daqp")
    fixed = QPMPC.from_model(
        [[0.9, 0.1], [0.0, 1.0]],
        [[0.5], [0.0]],
        4,
        stage_weight=[1.0, 1.0, 0.1],
        constraints=([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [2.0, -1.0], [2.0, 1.0]),
        constraint_slack=torch.inf,
        solver="daqp",
    )
    for mpc, value in ((constant.plan, 1.0), (fixed, 2.0)):
        tables = make_tables(mpc)
        last = draw(tables, 20)[:, -1]
        assert abs(last - value).max() < 1e-12
        assert abs(tables.centre[-1] - value) < 1e-12
        agreement = export_c(mpc, tmp_path).agreement
        assert agreement.solved > 30


@needs_compiler
def test_an_entry_without_an_effect_up_to_rounding_is_exported(tmp_path):
    A, B = [[1.2, 1e-16], [0.0, 1.0]], [[0.5], [0.0]]
    weight = [1.0, 1e-16, 0.1]
    mpc = QPMPC.from_model(A, B, 4, stage_weight=weight, action_bounds=([-1.0], [1.0]))
    assert abs(draw(make_tables(mpc), 100)[:, 1]).max() < 100
    agreement = export_c(mpc, tmp_path).agreement
    assert agreement.u < 1e-6


@needs_compiler
@pytest.mark.parametrize("pole", [np.nextafter(1.5, 0), 2.0])
def test_states_that_leave_nothing_but_the_open_loop_of_an_unstable_plant_are_certified(
    pole, tmp_path
):
    """All inputs are at bounds: gap and action are what the rounding of Q makes of lambda."""
    horizon = 20 if pole < 2 else 12
    mpc = qm.LinearMPC(([[pole]], [[1.0]]), horizon, Q=1.0, R=0.1, u_bounds=(-1.0, 1.0)).plan
    agreement = export_c(mpc, tmp_path).agreement
    assert (agreement.solved, agreement.unsolved) == (agreement.states, 0)
    assert 1e-10 < agreement.value < 1e-7
    assert len(make_tables(mpc).known.Y) == 0  # no row of rounding is an equation of p


@needs_compiler
def test_a_policy_whose_actions_are_mostly_zero_is_exported(tmp_path):
    """Rounding of zero is no error beside the actions at the ends of the zone."""
    model = ([[1.0]], [[0.5]])
    mpc = qm.LinearMPC(model, 4, R=1.0, y_bounds=(-300.0, 1e10), u_bounds=(-1.5, 1.0))
    for policy in (mpc.plan, mpc.targets):
        export_c(policy, tmp_path)


@needs_compiler
def test_the_self_test_fails_for_other_tables(tmp_path):
    (header, source) = export_c(tied(), tmp_path).files
    text = source.read_text()
    start = text.index("U_OFFSET[1] =") + len("U_OFFSET[1] =\n")
    source.write_text(f"{text[:start]}{{0.5}};{text[text.index(';', start) + 1 :]}")
    assert read(header.parent).selftest() == 1
