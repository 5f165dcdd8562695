"""Exports that are compiled and compared in little time."""

from __future__ import annotations

import pytest

from torch_qpmpc.control import exporting
from torch_qpmpc.export import export, library


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(exporting, "FLAGS", ("-std=c99", "-O0", "-fPIC", "-shared"))
    monkeypatch.setattr(library, "FLAGS", ("-std=c99", "-O0", "-fPIC", "-shared"))
    monkeypatch.setattr(export, "COMPARED", 60)
    monkeypatch.setattr(exporting, "COMPARED", 60)
