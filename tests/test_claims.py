import re
from pathlib import Path

import pytest

from tests.campaign.families import FAMILIES
from tests.claims.__main__ import ROOT, load, main
from tests.pages import PAGES, needs_docs
from tests.runs import make_config

CLAIMS = load()


@needs_docs
@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.command)
def test_pages_quote_what_the_claims_say(claim):
    for number in claim.numbers:
        for page, text, quoted in number.quotes():
            words = " ".join(PAGES[page].split())
            assert " ".join(text.split()) in words, f"{page} lacks '{text}'"
            assert number.holds(quoted), f"{page}: {quoted} is not in {number.within}"


def test_commands_of_claims_have_possible_settings():
    for claim in CLAIMS:
        for words in re.findall(r"python train.py (?!-m )([^&;]*)", claim.command):
            make_config(*(word.strip("'") for word in words.split()))
    assert any(claim.quick for claim in CLAIMS)


@needs_docs
def test_the_campaigns_page_has_every_family():
    page = (ROOT / "docs/reliability/measured.md").read_text(encoding="utf-8")
    rows = page.split("<!-- campaign-families -->")[1].split("<!-- /campaign-families -->")[0]
    named = [row.split(" | ")[0].removeprefix("| ") for row in rows.splitlines() if row]
    assert sorted(", ".join(named[2:]).split(", ")) == sorted(FAMILIES)


def claims(path: Path, command: str, number: str, *, quick: bool = True) -> list[str]:
    """Write a file of one claim; return the arguments that name it."""
    text = f"- command: {command}\n  quick: {quick}\n  numbers:\n    - {number}\n"
    path.write_text(text, encoding="utf-8")
    return ["--claims", str(path)]


OUTPUT = r"{{output: 'cost (\S+)', within: [1000, 1100], pages: {{page.md: 'costs {{{}}} EUR'}}}}"


@pytest.mark.parametrize(
    ("command", "stale", "message"),
    [
        ("echo cost 1,024", 0, "cost (\\S+): 1024, in [1000, 1100]"),
        ("echo cost 1,124", 1, "page.md: 'costs 1,023 EUR' is now 1124"),
        ("echo nothing", 1, "page.md: 'costs 1,023 EUR' is now nan"),
        ("ls FOLDER/lost", 1, "page.md: the command failed"),
    ],
)
def test_a_number_outside_its_interval_makes_its_pages_stale(
    tmp_path, capsys, command, stale, message
):
    assert main(claims(tmp_path / "a.yaml", command, OUTPUT.format("1,023"))) == stale
    assert message in capsys.readouterr().out


def test_keys_of_the_summary_are_read(tmp_path, capsys):
    number = "{summary: rivals.best, within: [1, 2], pages: {page.md: 'J is {1.5}'}}"
    command = """'echo "{\\"rivals\\": {\\"best\\": 1.5}}" > FOLDER/summary.json'"""
    assert main(claims(tmp_path / "a.yaml", command, number)) == 0
    assert "rivals.best: 1.5, in [1, 2]" in capsys.readouterr().out


def test_only_what_is_asked_for_runs(tmp_path, capsys):
    arguments = claims(tmp_path / "a.yaml", "ls nowhere", OUTPUT.format("1,023"), quick=False)
    assert main([*arguments, "--quick"]) == main([*arguments, "--only", "true"]) == 0
    assert "nowhere" not in capsys.readouterr().out
