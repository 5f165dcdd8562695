import pytest

from tests.benchmarks.table import table, write_section
from torch_qpmpc import QPError


def test_a_table_has_its_numbers_to_the_right():
    assert table(["a", "b"], [["x", "1"], ["y", "2"]]).splitlines() == [
        "| a | b |",
        "| --- | ---: |",
        "| x | 1 |",
        "| y | 2 |",
    ]


def test_only_text_between_the_markers_changes(tmp_path):
    text, page = (
        "before\n<!-- it -->\n\nold\n\n<!-- /it -->\nafter <!-- other -->\n",
        tmp_path / "a.md",
    )
    page.write_text(text)
    write_section(page, "new", "it")
    assert page.read_text() == text.replace("old", "new")


@pytest.mark.parametrize(
    "text", ["", "<!-- it -->", "<!-- /it --><!-- it -->", 2 * "<!-- it --><!-- /it -->"]
)
def test_missing_markers_are_refused(text, tmp_path):
    page = tmp_path / "a.md"
    page.write_text(text)
    message = r"a\.md: got \d and \d, expected one line <!-- it --> and below it one line"
    with pytest.raises(QPError, match=message):
        write_section(page, "new", "it")
