from __future__ import annotations

import pytest

from torch_qpmpc import QPError
from torch_qpmpc.study.markdown import replaced, table


def test_a_table_has_its_numbers_to_the_right():
    assert table(["a", "b"], [["x", "1"], ["y", "2"]]).splitlines() == [
        "| a | b |",
        "| --- | ---: |",
        "| x | 1 |",
        "| y | 2 |",
    ]


def test_only_text_between_the_markers_changes():
    text = "before\n<!-- it -->\n\nold\n\n<!-- /it -->\nafter <!-- other -->\n"
    assert replaced(text, "new", "it") == text.replace("old", "new")


@pytest.mark.parametrize(
    "text", ["", "<!-- it -->", "<!-- /it --><!-- it -->", 2 * "<!-- it --><!-- /it -->"]
)
def test_missing_markers_are_refused(text):
    with pytest.raises(QPError, match="expected one line <!-- it --> and below it one line"):
        replaced(text, "new", "it")
