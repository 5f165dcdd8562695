"""Compile quickly, and compare at few states, in the tests of the export."""

from __future__ import annotations

import pytest

from torch_qpmpc.export import export, library


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(library, "FLAGS", ("-std=c99", "-O0", "-fPIC", "-shared"))
    monkeypatch.setattr(export, "COMPARED", 100)
