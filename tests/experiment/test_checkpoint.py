"""Damage of checkpoints is found."""

from pathlib import Path

import pytest
import torch

from torch_qpmpc import QPError
from torch_qpmpc.files import load_file, save_file
from torch_qpmpc.mpc.state import KIND


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Write a checkpoint."""
    path = tmp_path / "checkpoint.pt"
    save_file(path, KIND, {"C": torch.arange(99.0)})
    return path


def test_a_flipped_bit_is_found_or_changes_nothing(path):
    whole, refused = path.read_bytes(), []
    # All bytes of the archive's directory at the end, and some of the rest.
    positions = sorted({*range(0, len(whole), 61), *range(len(whole) - 300, len(whole))})
    for position in positions:
        data = bytearray(whole)
        data[position] ^= 1 << 7
        path.write_bytes(data)
        try:
            found = load_file(path, KIND)
        except QPError as error:
            refused.append(str(error))
        else:
            assert torch.equal(found["C"], torch.arange(99.0)), position
    assert len(refused) > len(positions) / 4
    assert all("which cannot be read" in sentence for sentence in refused)


def test_a_truncated_a_missing_and_another_file_are_named(path):
    data = path.read_bytes()
    for content in (data[: len(data) // 2], data[:-5], b"", b"not a checkpoint"):
        path.write_bytes(content)
        with pytest.raises(QPError, match=r"path: got .*checkpoint.pt, which cannot be read"):
            load_file(path, KIND)
    path.unlink()
    with pytest.raises(QPError, match=r"path: got .*checkpoint.pt, which does not exist"):
        load_file(path, KIND)
