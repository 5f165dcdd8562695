"""The excluded ones of TorchRL's tests with the reasons, and a table of counts."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
import torchrl

from tests.drop_in import networks


@pytest.fixture(autouse=True, params=["state", "preview", "scheduled"])
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run every test with QPs of a state, of a preview, too, and of a theta from a network."""
    monkeypatch.setattr(networks, "PREVIEW", request.param == "preview")
    monkeypatch.setattr(networks, "SCHEDULED", request.param == "scheduled")


#: Reasons by the end of a test's name.
LEFT_OUT = {
    "prioritized_weights": (
        "makes its own networks, so that it tests none of ours; and TorchRL's C++ extension, "
        "which its prioritized buffers need, does not load with every torch"
    )
}


def pytest_collection_modifyitems(items: list[Any]) -> None:
    for item in items:
        for ending, reason in LEFT_OUT.items():
            if "drop_in" in item.nodeid and item.originalname.endswith(ending):
                item.add_marker(pytest.mark.skip(reason=reason))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    counts: dict[str, Counter[str]] = {}
    for outcome in ("passed", "failed", "error", "skipped"):
        for report in terminalreporter.getreports(outcome):
            if "drop_in" not in report.nodeid or report.nodeid.count("::") < 2:
                continue
            group = report.nodeid.split("::")[1]
            why = outcome
            if outcome == "skipped":
                left_out = any(reason in str(report.longrepr) for reason in LEFT_OUT.values())
                why = "left out" if left_out else "skipped by TorchRL"
            if outcome != "passed" or report.when == "call":
                counts.setdefault(group, Counter())[why] += 1
    if counts:
        terminalreporter.section(f"TorchRL's own tests on QPs, torchrl {torchrl.__version__}")
        for group, found in counts.items():
            terminalreporter.write_line(f"{group}: {dict(found)}")
