"""``train.py export=c`` and ``python -m torch_qpmpc.export``."""

from __future__ import annotations

import pytest

import train
from tests.runs import SMALL, make_config
from torch_qpmpc import QPMPC
from torch_qpmpc.experiment.run_folder import export_run
from torch_qpmpc.export.__main__ import main
from torch_qpmpc.export.library import Library, compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def test_a_run_is_exported_at_its_end_and_afterwards(tmp_path, capsys):
    cfg = make_config(*SMALL, "export=c")
    train.train(cfg, str(tmp_path))
    printed = capsys.readouterr().out
    assert "actions within" in printed
    first = (tmp_path / "c" / "policy.h").read_text()
    assert Library(tmp_path / "c", "policy", "float64").selftest() == 0
    main([str(tmp_path), "--folder", str(tmp_path / "again"), "--storage", "small"])
    assert "small" in capsys.readouterr().out
    again = (tmp_path / "again" / "policy.h").read_text()
    assert first.split("SHA-256")[1].split("\n")[0] == again.split("SHA-256")[1].split("\n")[0]


def test_a_folder_without_a_run_is_refused(tmp_path):
    match = "RUN_FOLDER: got .*, which has no checkpoint.pt, expected the folder of a run of train"
    with pytest.raises(SystemExit, match=match):
        main([str(tmp_path)])


def test_a_run_that_cannot_be_exported_is_a_warning(tmp_path):
    mpc = QPMPC.of(1, 2, 2, B=[[1.0, 1.0]], stage_weight=[1.0, 0.0, 0.0])
    with pytest.warns(UserWarning, match="The policy is not exported. H: got eigenvalues"):
        export_run(mpc, tmp_path, quiet=False)


def test_a_quiet_export_prints_nothing(tmp_path, capsys):
    export_run(QPMPC.of(1, 1, 2, stage_weight=[1.0, 1.0]), tmp_path, quiet=True)
    assert not capsys.readouterr().out
