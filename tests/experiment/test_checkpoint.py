"""Checkpoints are written atomically, keep the previous one, and are read without running code."""

from __future__ import annotations

import contextlib
import errno
import os
import pickle
import zipfile
from pathlib import Path

import pytest
import torch

from torch_qpmpc import QPMPC, QPError
from torch_qpmpc.experiment.checkpoint import (
    PREVIOUS,
    drop_previous,
    load_checkpoint,
    save_checkpoint,
)


def same(first: object, second: object) -> bool:
    if isinstance(first, torch.Tensor):
        return isinstance(second, torch.Tensor) and torch.equal(first, second)
    if isinstance(first, dict):
        return isinstance(second, dict) and all(same(first[k], second[k]) for k in first | second)
    if isinstance(first, list):
        return isinstance(second, list) and all(map(same, first, second))
    return first == second


def make_state(update: int = 3) -> dict:
    """Make the state of a module and an optimiser after one step."""
    mpc = QPMPC.of(2, 1, 3, solver="daqp")
    optimizer = torch.optim.Adam(mpc.parameter_groups({"cost": 2e-2, "constraints": 2e-3}))
    mpc.value(torch.ones(4, 2)).mean().backward()
    optimizer.step()
    return {"mpc": mpc.state_dict(), "optimizer": optimizer.state_dict(), "update": update}


def test_round_trip(tmp_path):
    state = make_state()
    save_checkpoint(tmp_path / "checkpoint.pt", state)
    loaded = load_checkpoint(str(tmp_path / "checkpoint.pt"))
    assert loaded.keys() == state.keys()
    assert same(loaded, state)
    assert not same(loaded, make_state(4))
    twin = QPMPC.of(2, 1, 3, solver="daqp", seed=5)
    twin.load_state_dict(loaded["mpc"])
    optimizer = torch.optim.Adam(twin.parameter_groups({"cost": 1.0, "constraints": 1.0}))
    optimizer.load_state_dict(loaded["optimizer"])
    assert optimizer.param_groups[0]["lr"] == 2e-2
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_a_later_checkpoint_replaces_the_earlier_one(tmp_path):
    path = tmp_path / "checkpoint.pt"
    for update in (1, 2):
        save_checkpoint(path, make_state(update))
        assert load_checkpoint(path)["update"] == update


@pytest.mark.parametrize("when", ["writing", "syncing"])
def test_a_crash_keeps_the_previous_one(tmp_path, monkeypatch, when):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, make_state(1))
    before = path.read_bytes()

    def half(state, file):
        file.write(before[: len(before) // 2])
        raise OSError("No space left on device")

    def no_sync(descriptor):
        raise OSError("Input/output error")

    if when == "writing":
        monkeypatch.setattr(torch, "save", half)
    else:
        monkeypatch.setattr(os, "fsync", no_sync)
    with pytest.raises(OSError, match=r"No space left|Input/output"):
        save_checkpoint(path, make_state(2))
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert load_checkpoint(path)["update"] == 1
    save_checkpoint(path, make_state(3))  # the crash's leftovers do not interfere
    assert load_checkpoint(path)["update"] == 3


def test_the_checkpoint_before_is_kept_and_dropped_at_the_end(tmp_path):
    path = tmp_path / "checkpoint.pt"
    for update in (1, 2, 3):
        save_checkpoint(path, make_state(update))
    assert load_checkpoint(tmp_path / PREVIOUS)["update"] == 2
    assert {found.name for found in tmp_path.iterdir()} == {"checkpoint.pt", PREVIOUS}
    drop_previous(path)
    assert [found.name for found in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_a_damaged_checkpoint_does_not_replace_the_previous_one(tmp_path, monkeypatch):
    """Resume from the previous checkpoint on a full disk."""
    path = tmp_path / "checkpoint.pt"
    for update in (1, 2):
        save_checkpoint(path, make_state(update))
    path.write_bytes(b"damaged")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            save_checkpoint(path, make_state(3))
    assert load_checkpoint(tmp_path / PREVIOUS)["update"] == 1
    assert {found.name for found in tmp_path.iterdir()} == {"checkpoint.pt", PREVIOUS}


@pytest.mark.parametrize("bit", [0, 7])
def test_a_flipped_bit_is_found_or_changes_nothing(tmp_path, bit):
    state, path = make_state(), tmp_path / "checkpoint.pt"
    save_checkpoint(tmp_path / PREVIOUS, state)
    save_checkpoint(path, state)
    whole, refused = path.read_bytes(), []
    # All bytes of the archive's directory at the end, and some of the rest.
    positions = sorted({*range(0, len(whole), 61), *range(len(whole) - 300, len(whole))})
    for position in positions:
        data = bytearray(whole)
        data[position] ^= 1 << bit
        path.write_bytes(data)
        try:
            found = load_checkpoint(path)
        except QPError as error:
            refused.append(str(error))
        else:
            assert same(found, state), position
    assert len(refused) > len(positions) / 4
    assert all("use the previous one" in sentence for sentence in refused)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_truncated_checkpoint_is_an_error(tmp_path, share):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, make_state())
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(
        QPError, match=r"checkpoint: got .*checkpoint.pt, which cannot be read .* t"
    ):
        load_checkpoint(path)


def test_something_else_is_an_error(tmp_path):
    path = tmp_path / "checkpoint.pt"
    path.write_text("not a checkpoint", encoding="utf-8")
    with pytest.raises(QPError, match=r"cannot be read .* expected a checkpoint that train"):
        load_checkpoint(path)
    with pytest.raises(QPError, match="cannot be read"):
        load_checkpoint(tmp_path)


def test_a_missing_checkpoint_is_an_error(tmp_path):
    with pytest.raises(QPError, match=r"checkpoint: got .*none.pt, which does not exist"):
        load_checkpoint(tmp_path / "none.pt")


class Touch:
    """Content of a malicious file: unpickling it runs code."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


def test_loading_runs_no_code(tmp_path):
    victim, path = tmp_path / "victim", tmp_path / "checkpoint.pt"
    torch.save({"mpc": Touch(victim)}, path)
    with pytest.raises(QPError, match=r"UnpicklingError.* more than tensors"):
        load_checkpoint(path)
    assert not victim.exists()
    pickle.loads(pickle.dumps(Touch(victim)))
    assert victim.exists(), "it would have"


def test_no_member_of_the_file_is_run(tmp_path):
    """Replace each member of the file in turn by a malicious pickle."""
    victim, path = tmp_path / "victim", tmp_path / "checkpoint.pt"
    save_checkpoint(path, make_state())
    with zipfile.ZipFile(path) as file:
        members = {name: file.read(name) for name in file.namelist()}
    for evil in members:
        with zipfile.ZipFile(path, "w") as file:
            for name, data in members.items():
                file.writestr(name, pickle.dumps(Touch(victim)) if name == evil else data)
        with contextlib.suppress(QPError):
            load_checkpoint(path)
        assert not victim.exists(), evil
