import json
import math
import shutil
from typing import Any

import numpy as np
import pytest
import torch

import torch_qpmpc as qm
import train
from tests.runs import SMALL, make_config
from torch_qpmpc import QPError
from torch_qpmpc.analysis.structure import NearestModel
from torch_qpmpc.envs import LinearSystem
from torch_qpmpc.experiment.algorithms import evaluate
from torch_qpmpc.identification.innovations import Innovations
from torch_qpmpc.study.runs import FinishedRun, collect, prediction_error


def test_every_run_is_a_row_in_the_papers_order(study):
    frame = collect(study)
    columns = (frame[name] for name in ("sweep", "noise", "label", "seed"))
    assert list(zip(*columns, strict=True)) == [
        ("small", "brownian", "free", 1),
        ("small", "gaussian", "fixed", 1),
        ("small", "gaussian", "free", 1),
        ("small", "gaussian", "free", 4),
        ("weights", "gaussian", "identified, c_2=0", 1),
        ("weights", "gaussian", "identified, c_2=0.5", 1),
    ]
    assert frame["real"].tolist() == [True, True, True, False, True, True]
    assert set(collect(study / "small")["sweep"]) == {"small"}
    assert len(collect(study / "small" / "gaussian-free-seed1")) == 1


def test_where_C_is_fixed_its_model_is_the_corrupted_one(study):
    frame = collect(study / "small")
    fixed, free = (frame.query(f"constraint == {case!r}") for case in ("fixed", "free"))
    assert fixed["canonical_distance"].tolist() == pytest.approx([0], abs=1e-9)
    ends = (fixed[name].tolist() for name in ("prediction_error", "prediction_error_start"))
    assert next(ends) == pytest.approx(next(ends))
    assert min(free["canonical_distance"]) > 1e-4
    assert all(free["prediction_error"] != free["prediction_error_start"])
    assert set(fixed["zeros_above"]) == {1.0}
    assert max(free["zeros_above"]) < 0.1


def test_a_C_that_determines_no_states_has_no_error(study):
    run = FinishedRun(study / "small" / "gaussian-free-seed1")
    with torch.no_grad():
        run.policy.C.zero_()
    assert math.isnan(run.readings()["prediction_error"])


def test_the_radius_is_that_of_the_true_plant_at_the_origin(study):
    run = FinishedRun(study / "small" / "gaussian-free-seed1")
    plant: Any = run.physics
    A, B, _ = plant.true_model()
    with torch.no_grad():
        slope = run.policy.policy(1e-4 * torch.eye(4).to(A)).mT / 1e-4
    radius = torch.linalg.eigvals(A + B @ slope).abs().max().item()
    assert run.readings()["radius"] == pytest.approx(radius, rel=1e-5)


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


def test_an_ablation_is_labelled_by_its_name(study, tmp_path):
    for name in ("one", "two"):
        shutil.copytree(study / "small" / "gaussian-free-seed1", tmp_path / name)
        summary = tmp_path / name / "summary.json"
        summary.write_text(summary.read_text().replace('ablation": null', f'ablation": "{name}"'))
    assert collect(tmp_path)["label"].tolist() == ["free, one", "free, two"]


@pytest.fixture(scope="module")
def gated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gated")
    more = ("gate=true", "constraint=mpc")
    train.train(make_config(*SMALL, *more), str(folder), quiet=True)
    return folder


def test_a_run_is_loaded_with_what_it_wrote(gated, tmp_path):
    run = qm.load_run(gated)
    assert run.policy.structure == run.start.structure == "tied"
    assert run.summary["accepted"] > 0
    s = torch.ones(3, run.policy.n_p)
    assert torch.equal(run.policy.policy(s), qm.QPMPC.load(gated / "best.pt").policy(s))
    assert run.summary["J_best"] == run.metrics["eval/J"].iloc[-1]
    for mpc, J in ((run.start, "J_start"), (run.policy, "J_best")):
        now = evaluate(run.cfg, mpc.policy, run.physics).J
        assert now == pytest.approx(run.summary[J], rel=1e-6)
    assert run.cfg.task.name == "point_mass"
    with pytest.raises(QPError, match=r"^folder: got .*, without config.yaml, expected the folder"):
        qm.load_run(tmp_path)


def test_a_run_of_another_version_has_its_policy(gated, tmp_path):
    shutil.copytree(gated, tmp_path, dirs_exist_ok=True)
    config = tmp_path / "config.yaml"
    config.write_text(f"gone: 3\n{config.read_text()}")
    run, s = qm.load_run(tmp_path), np.ones(4)
    assert run.predict(s) == pytest.approx(qm.load_run(gated).predict(s))
    with pytest.raises(QPError, match="gone: got an unknown key"):
        _ = run.cfg


@pytest.fixture
def acting(tmp_path):
    """Make a run whose policy, with soft bounds, acts on an observer's estimate."""
    A, one, zero = np.array([[0.9, 0.5], [0.0, 0.8]]), np.eye(2), np.zeros(2)
    B, C = np.array([[0.0], [0.5]]), np.array([[1.0, 0.0]])
    L, none = np.array([[0.5], [0.2]]), np.zeros((2, 0))
    run: Any = FinishedRun(tmp_path)
    run.observer = Innovations(A, B, none, zero, C, L, one[:1, :1], zero, 0 * one)
    bounds = {"action_bounds": ([-1.0], [0.5]), "action_slack": 0.1}
    run.policy = qm.QPMPC.from_model(A, B, 5, stage_weight=[1.0, 1.0, 0.01], **bounds)
    return run


def test_a_run_s_action_is_within_soft_bounds_and_its_observer_knows_it(acting):
    kalman = qm.envs.KalmanFilter(acting.observer)
    x, u, excess = torch.zeros(2), torch.zeros(1), torch.tensor(0.0)
    for k, y in enumerate(torch.tensor([[40.0], [-60.0], [20.0]])):
        x = kalman.following(x, u, x[:0], y, k) if k else kalman.first(y)
        wanted = acting.policy.policy(x).detach()
        u = wanted.clamp(-1.0, 0.5)
        excess += (u - wanted).abs().sum()
        assert acting.predict(y) == pytest.approx(u.numpy(), abs=1e-9)
    assert excess > 0.1, "soft bounds were exceeded"
    acting.observer = None
    action = acting.predict(np.array([9.0, 0.0], np.float32))
    assert (action, action.dtype) == (-1.0, np.float32)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.ones((3, 1)), r"got shape \(3, 1\), expected shape \(1,\). Pass begins=True"),
        (np.ones(2), r"got shape \(2,\), expected shape \(\*batch, 1\)"),
        ({"y": 1.0}, r"got \{'y': 1\.0\}, expected a tensor, or"),
    ],
)
def test_an_observation_that_does_not_continue_the_episode_is_an_error(
    acting, observation, message
):
    acting.predict([1.0])
    with pytest.raises(QPError, match=f"^observation: {message}"):
        acting.predict(observation)
    assert acting.predict(np.ones((3, 1)), begins=True).shape == (3, 1)


@pytest.mark.parametrize(
    ("file", "content", "wrong"),
    [
        ("config.yaml", b"[]\n", r"config.yaml: got .* \(it is a list\), expected the config"),
        ("config.yaml", b"seed: 1\nsolver: daqp\n", r"config.yaml: got .* \(eval_seed: got noth"),
        ("config.yaml", b"seed: \xff\n", r"config.yaml: got .* \('utf-8' codec can't decode"),
        ("config.yaml", None, r"config.yaml: got .* \(.*No such file"),
        ("summary.json", b"junk", r"summary.json: got .* \(Expecting value"),
        ("summary.json", b"[]", r"summary.json: got .* \(list indices must be integers"),
        ("summary.json", b"{}", r"summary.json: got .* \(it has no seed"),
        ("summary.json", b'{"seed": "one"}', r"summary.json: got .* \(seed is 'one'"),
        *(
            ("summary.json", {name: value}, rf"summary.json: got .* \({name} is {value!r}\)")
            for name, value in (("J_best", "x"), ("J_true_model", {}), ("canonical_distance", "x"))
        ),
        ("metrics.csv", b"update,eval/J\n0,", r"metrics.csv: got .* \(its last line is cut off"),
        ("best.pt", None, "path: got .*best.pt, which does not exist"),
        ("best.pt", b"junk", "path: got .*best.pt, which cannot be read"),
    ],
)
def test_a_damaged_file_is_named(gated, tmp_path, file, content, wrong):
    run = qm.load_run(shutil.copytree(gated, tmp_path / "run"))
    if isinstance(content, dict):
        content = json.dumps(run.summary | content).encode()
    (run.folder / file).unlink()
    if content is not None:
        (run.folder / file).write_bytes(content)
    of = {"config.yaml": "cfg", "summary.json": "summary", "metrics.csv": "metrics"}
    with pytest.raises(QPError, match=f"^{wrong}"):
        getattr(run, of.get(file, "policy"))
    if file == "summary.json":
        shutil.copy(run.folder / "best.pt", run.folder / "checkpoint.pt")
        (run.folder / file).unlink(missing_ok=True)
        with pytest.raises(QPError, match=r"a stopped run, expected a finished run\. Finish it: "):
            _ = run.summary


def test_a_folder_without_runs_and_a_run_with_other_keys_are_named(gated, tmp_path):
    with pytest.raises(QPError, match=r"RUNS_FOLDER: got .* without a finished run"):
        collect(tmp_path)
    config = shutil.copytree(gated, tmp_path / "run") / "config.yaml"
    config.write_text(config.read_text().replace("step: chol", "weather: fine\nstep: chol", 1))
    message = r"config.yaml: got .* \(weather: got an unknown key, .* that a run of this version"
    with pytest.raises(QPError, match=message):
        collect(tmp_path)
