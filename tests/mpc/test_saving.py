"""Save, load and predict: files that run no code, that later releases read, and arrays."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.problems import drawn_mpc
from tests.refused import refused
from torch_qpmpc import QPMPC, QPError, files
from torch_qpmpc.qp.solvers import BACKENDS

FOLDER = Path(__file__).parent


def small() -> QPMPC:
    """Make a QPMPC that has learned, with a preview, masks and soft and hard rows."""
    torch.manual_seed(0)
    mpc = QPMPC.of(
        1,
        1,
        horizon=2,
        n_d=1,
        A=[[0.9]],
        B=[[0.5]],
        E=[[0.2]],
        stage_weight=[1.0, 0.1],
        state_bounds=([-1.0], [1.0]),
        action_bounds=([-0.5], [0.5]),
        learn={"H": True, "c": True, "C": torch.arange(16).reshape(2, 8) % 2 == 0},
        solver="daqp",
        on_failure="mask",
    )
    optimizer = torch.optim.Adam(mpc.parameters(), lr=0.1)
    mpc.value(torch.ones(mpc.n_p)).backward()
    optimizer.step()
    return mpc


def test_later_releases_read_the_format():
    """``python -m tests.mpc.test_saving`` has written the file."""
    mpc = QPMPC.load(FOLDER / "saved-3.qpmpc")
    p = np.array([[0.0, 0.1, 0.0, 0.2], [0.1, 0.2, 0.3, 0.9]])
    assert_close(mpc.predict(p), np.array([[-0.248052501107], [-0.5]]), rtol=0, atol=1e-9)
    assert mpc.learned == ("H", "c", "C")


def test_a_parametrization_of_the_users_is_refused(tmp_path):
    mpc = drawn_mpc(1, 1, 2, stage_weight=[1.0, 1.0])
    torch.nn.utils.parametrize.register_parametrization(mpc, "C", torch.nn.Identity())
    with pytest.raises(QPError, match=r"^save: got a parametrization of C that is not QPMPC"):
        mpc.save(tmp_path / "file")
    assert not (tmp_path / "file").exists()


# Files that are not a QPMPC


def test_another_file_is_named(tmp_path):
    torch.save([1.0], tmp_path / "list")
    with pytest.raises(QPError, match="list, which another program wrote"):
        QPMPC.load(tmp_path / "list")
    (tmp_path / "text").write_text("x")
    with pytest.raises(QPError, match=r"text, which cannot be read \(BadZipFile\), expected a fil"):
        QPMPC.load(tmp_path / "text")
    with pytest.raises(QPError, match="none, which does not exist, expected a file that QPMPC"):
        QPMPC.load(tmp_path / "none")
    for kind, version, message in (
        ("network", 1, "a saved network, expected a file that QPMPC.save wrote"),
        ("QPMPC", 1, "whose format has version 1, expected version 3. Make the file again."),
        ("QPMPC", 4, "whose format has version 4, expected version 3. A newer release w"),
    ):
        torch.save({"kind": kind, "version": version}, tmp_path / "other")
        with pytest.raises(QPError, match=f"^path: got .*/other, {message}"):
            QPMPC.load(tmp_path / "other")


def test_a_file_without_a_part_is_named(tmp_path):
    drawn_mpc(1, 1, 2).save(tmp_path / "file")
    content = torch.load(tmp_path / "file")
    del content["mpc"]["q"]
    torch.save(content, tmp_path / "file")
    message = (
        r"^file: got .*/file \(Error\(s\) in loading .* Missing key.*wrote\. Restore the file, or"
    )
    with pytest.raises(QPError, match=message):
        QPMPC.load(tmp_path / "file")


def test_a_file_with_a_backend_that_is_not_registered_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(BACKENDS, "mine", BACKENDS["daqp"])
    drawn_mpc(1, 1, 2, solver="mine").save(tmp_path / "file")
    monkeypatch.delitem(BACKENDS, "mine")
    with pytest.raises(QPError, match=r"solver: got 'mine'.* or register the solver that it names"):
        QPMPC.load(tmp_path / "file")


# Predict


@refused(
    (np.ones(3), r"observation: got shape \(3,\), expected shape \(\*batch"),
    (1.0, r"observation: got shape \(1,\), expected shape \(\*batch"),
    (np.ones((2, 1)), r"observation: got shape \(2, 1\), expected shape \(\*batch"),
    ((np.ones(2), {}), r"observation: got tuple, .* \(\.\., 2\)\. Pass the observation"),
    ({"observation": np.ones(2)}, r"observation: got dict, .* \(\.\., 2\)\. Pass the obs"),
)
def test_other_than_an_observation_is_named(observation):
    drawn_mpc(2, 1, 3).predict(observation)


if __name__ == "__main__":
    small().save(FOLDER / f"saved-{files.VERSION}.qpmpc")
