from __future__ import annotations

import math
import shutil

import pytest
import torch

import torch_qpmpc as qm
import train
from tests.problems import normal
from tests.runs import SMALL, make_config
from torch_qpmpc import QPError
from torch_qpmpc.analysis.report import canonical
from torch_qpmpc.analysis.structure import NearestModel
from torch_qpmpc.envs import LinearSystem
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.experiment.config import load_config
from torch_qpmpc.experiment.lock import LOCK
from torch_qpmpc.experiment.sweeps import finished_run
from torch_qpmpc.export.__main__ import main as export
from torch_qpmpc.study.report import main as report
from torch_qpmpc.study.runs import FinishedRun, collect, prediction_error


def test_every_run_is_a_row_in_the_papers_order(study):
    frame = collect(study)
    columns = (frame[name] for name in ("sweep", "noise", "label", "seed"))
    assert list(zip(*columns, strict=True)) == [
        ("small", "brownian", "free", 1),
        ("small", "gaussian", "fixed", 1),
        ("small", "gaussian", "fixed", 4),
        ("small", "gaussian", "free", 1),
        ("small", "gaussian", "free", 4),
        ("weights", "gaussian", "identified, c_2=0.0", 1),
        ("weights", "gaussian", "identified, c_2=0.5", 1),
    ]
    assert frame["real"].tolist() == [True, True, False, True, False, True, True]


def test_a_sweep_is_named_by_its_folder(study):
    assert set(collect(study / "small")["sweep"]) == {"small"}


def test_one_run_is_enough(study):
    assert len(collect(study / "small" / "gaussian-free-seed1")) == 1


def test_a_lock_file_that_was_left_is_ignored(study):
    folder = study / "small" / "gaussian-free-seed1"
    (folder / LOCK).touch()
    try:
        assert len(collect(folder)) == 1
    finally:
        (folder / LOCK).unlink()


def test_the_learned_qp_is_the_one_that_was_evaluated(study):
    for row in collect(study / "small").to_dict("records"):
        run = row["run"]
        for mpc, then in ((run.start, row["J_start"]), (run.policy, row["J_best"])):
            now = evaluate(run.cfg, mpc.policy, run.physics).J
            assert now == pytest.approx(then, rel=1e-6)


def test_where_C_is_fixed_its_model_is_the_corrupted_one(study):
    frame = collect(study / "small")
    fixed, free = (frame.query(f"constraint == {case!r}") for case in ("fixed", "free"))
    assert fixed["canonical_distance"].tolist() == pytest.approx([0, 0], abs=1e-9)
    assert fixed["prediction_error"].tolist() == pytest.approx(
        fixed["prediction_error_start"].tolist()
    )
    assert min(free["canonical_distance"]) > 1e-4
    assert all(free["prediction_error"] != free["prediction_error_start"])


def test_readings_do_not_depend_on_the_gauge(study):
    run = FinishedRun(study / "small" / "gaussian-free-seed1")
    before, matrix = run.readings(), canonical(run.policy)
    T = torch.eye(len(run.policy.C)) + 0.1 * normal(*2 * [len(run.policy.C)])
    with torch.no_grad():
        run.policy.C.copy_(T @ run.policy.C)
    assert run.readings() == pytest.approx(before, rel=1e-6)
    torch.testing.assert_close(canonical(run.policy), matrix, rtol=1e-6, atol=1e-8)


def test_constraints_that_determine_no_states_have_no_readings(study):
    run = FinishedRun(str(study / "small" / "gaussian-free-seed1"))
    with torch.no_grad():
        run.policy.C.zero_()
    readings = run.readings()
    assert math.isnan(readings["prediction_error"])


def test_the_models_error_is_that_of_one_step(study):
    """An offset of 0.3 in one state gives an error of 0.3, a gain of 1 the state's spread."""
    physics = FinishedRun(study / "small" / "gaussian-free-seed1").physics
    assert isinstance(physics, LinearSystem)
    none = torch.zeros(4, dtype=torch.float64)
    A, B, E = physics.A, physics.B, torch.zeros(4, 0)
    assert prediction_error(NearestModel(A, B, E, none, none[0]), physics) == 0
    offset = none.index_fill(0, torch.tensor([2]), 0.3)
    assert prediction_error(NearestModel(A, B, E, offset, none[0]), physics) == pytest.approx(0.3)
    spread = prediction_error(NearestModel(A - torch.eye(4), B, E, none, none[0]), physics)
    assert spread == pytest.approx(math.sqrt(2 * (1.5**2 + 0.5**2) / 3), rel=0.05)


def test_exact_zeros_above_the_band_are_counted(study):
    frame = collect(study / "small")
    assert set(frame.query("constraint == 'fixed'")["zeros_above"]) == {1.0}
    assert max(frame.query("constraint == 'free'")["zeros_above"]) < 0.1


def test_an_ablation_is_labelled_by_its_name(study, tmp_path):
    for name in ("one", "two"):
        shutil.copytree(study / "small" / "gaussian-free-seed1", tmp_path / name)
        config = tmp_path / name / "config.yaml"
        config.write_text(config.read_text().replace("ablation: null", f"ablation: {name}"))
    assert collect(tmp_path)["label"].tolist() == ["free, one", "free, two"]


@pytest.fixture(scope="module")
def gated(tmp_path_factory):
    """Train a run whose learned policy is in best.pt."""
    folder = tmp_path_factory.mktemp("gated")
    train.train(make_config(*SMALL, "gate=true", "logger=csv"), str(folder), quiet=True)
    return folder


OURS = r"expected the configuration that a run wrote\. Restore the file, or "
CONFIGS = {
    "a list": (b"[]\n", "it is a list"),
    "empty": (b"", "it has no seed"),
    "a number": (b"5\n", "Invalid loaded object type: int"),
    "cut": (b"seed: 1\nsolver: daqp\n", "it has no eval_seed"),
    "bad YAML": (b"a: [1\nb: }", "while parsing a flow sequence"),
    "bad UTF-8": (b"seed: \xff\n", "'utf-8' codec can't decode byte 0xff"),
    "missing": (None, "No such file or directory"),
}


@pytest.mark.parametrize(("content", "wrong"), CONFIGS.values(), ids=CONFIGS)
def test_a_damaged_configuration_is_named_by_the_report(gated, tmp_path, content, wrong):
    folder = shutil.copytree(gated, tmp_path / "run")
    (folder / "config.yaml").unlink()
    if content is not None:
        (folder / "config.yaml").write_bytes(content)
    with pytest.raises(
        SystemExit, match=rf"^config\.yaml: got .*/config\.yaml \(.*{wrong}.*\), {OURS}"
    ):
        report([str(folder)])


def assert_not_exported(folder, sentence):
    with pytest.raises(SystemExit, match=f"^{sentence}"):
        export([str(folder)])


@pytest.mark.parametrize(
    ("content", "wrong"),
    [
        (b"junk", "Expecting value"),
        (b"", "Expecting value"),
        (b"[]", "list indices must be integers"),
        (b'{"a": "\xff"}', "'utf-8' codec can't decode byte 0xff"),
        (b"{}", "it has no seed"),
        (b'{"seed": "one"}', "seed is 'one'"),
    ],
)
def test_a_damaged_summary_is_named(gated, tmp_path, content, wrong):
    folder = shutil.copytree(gated, tmp_path / "run")
    (folder / "summary.json").write_bytes(content)
    sentence = rf"^summary\.json: got .*/summary\.json \({wrong}.*\), expected the outcome that a"
    with pytest.raises(SystemExit, match=sentence):
        report([str(folder)])
    with pytest.raises(QPError, match=sentence):
        finished_run(folder, load_config(folder / "config.yaml"))


@pytest.mark.parametrize("part", ["arguments", "mpc"])
def test_a_learned_qp_without_its_parts_is_named(gated, tmp_path, part):
    folder = shutil.copytree(gated, tmp_path / "run")
    state = torch.load(folder / "best.pt")
    torch.save({name: x for name, x in state.items() if name != part}, folder / "best.pt")
    wrong = rf"best\.pt: got .*/best\.pt \(it has no {part}\), expected a file that QPMPC.save wrot"
    assert_not_exported(folder, wrong)
    (folder / "best.pt").unlink()
    assert_not_exported(folder, r"path: got .*/best\.pt, which does not exist")


def test_a_run_is_loaded_with_what_it_wrote(gated, tmp_path):
    run = qm.load_run(gated)
    s = torch.ones(3, run.policy.n_p)
    assert torch.equal(run.policy.policy(s), qm.QPMPC.load(gated / "best.pt").policy(s))
    assert run.summary["J_best"] == run.metrics["eval/J"].iloc[-1]
    assert run.cfg.task.name == "point_mass"
    with pytest.raises(QPError, match=r"^folder: got .*, without config.yaml, expected the folder"):
        qm.load_run(tmp_path)


def test_a_policy_with_a_network_is_not_its_qp_alone(gated, tmp_path):
    folder = shutil.copytree(gated, tmp_path / "run")
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("\nalgo:\n", "\nalgo:\n  actor: scheduled\n"))
    message = "policy: got .* whose theta comes from a network, expected a run whose policy is a QP"
    run = qm.load_run(folder)
    assert run.qp.horizon == 3
    with pytest.raises(QPError, match=message):
        run.policy  # noqa: B018
    with pytest.raises(SystemExit, match=message):
        export([str(folder)])


def test_metrics_that_are_cut_are_named_by_the_report(gated, tmp_path):
    folder = shutil.copytree(gated, tmp_path / "run")
    text = (folder / "metrics.csv").read_text()
    (folder / "metrics.csv").write_text(text[: len(text) // 2])
    with pytest.raises(SystemExit, match=r"^metrics\.csv: got .*/metrics\.csv \(its last line is"):
        report([str(folder)])


def test_a_scheme_released_in_training_is_read(tmp_path):
    cfg = make_config(*SMALL, "constraint=mpc", "release=2")
    summary = train.train(cfg, str(tmp_path), quiet=True)
    run = FinishedRun(tmp_path)
    assert run.policy.structure == "free"
    now = evaluate(cfg, run.policy.policy, run.physics).J
    assert now == pytest.approx(summary["J_best"], rel=1e-6)


def test_a_folder_without_runs_is_named(tmp_path):
    with pytest.raises(QPError, match=r"RUNS_FOLDER: got .* without a finished run"):
        collect(tmp_path)


def test_a_checkpoint_that_is_lost_is_named(study, tmp_path):
    shutil.copytree(study / "small" / "gaussian-free-seed1", tmp_path / "run")
    (tmp_path / "run" / "checkpoint.pt").unlink()
    with pytest.raises(QPError, match=r"checkpoint: got .*checkpoint.pt, which does not exist"):
        collect(tmp_path)


def test_a_run_with_other_keys_is_named(study, tmp_path):
    shutil.copytree(study / "small" / "gaussian-free-seed1", tmp_path / "run")
    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace("step: chol", "weather: fine\nstep: chol", 1))
    with pytest.raises(QPError, match=r"run: got .*weather: got an unk.* expected a run of this"):
        collect(tmp_path)
