"""The documentation holds: its Python runs, its names exist."""

import doctest
import importlib
import importlib.util
import json
import re
import sys

import pytest

import torch_qpmpc
from tests.pages import DOCS, PAGES, ROOT, fenced, needs_docs
from tests.runs import SMALL, ended
from torch_qpmpc.experiment.tasks import TASKS
from torch_qpmpc.proofs import invariant
from torch_qpmpc.qp import solvers

#: The modules whose docstrings have examples.
EXAMPLES = sorted(
    path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
    for path in (ROOT / "torch_qpmpc").rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)

#: README.md learns by TorchRL in small, test_start.py from a log; tests/proofs asks smaller QPs,
#: and the tests of `improve` and of nonlinear plants have shorter loops.
SLOW = ("torchrl", "environment", "prove", "closed-loops", "scheduling")
SLOW = [f"docs/guides/{x}.md" for x in SLOW]


@pytest.mark.usefixtures("rough_fits")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow if page in SLOW else ())
        for page, text in PAGES.items()
        if fenced(text, "python")
    ],
)
def test_python_of_a_page_runs(page, tmp_path, monkeypatch):
    """Block after block, as a reader would paste them into one session."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(TASKS, "pole", raising=False)  # and again afterwards
    monkeypatch.setattr(solvers, "BACKENDS", dict(solvers.BACKENDS))
    monkeypatch.setattr(invariant, "GAINS", (1.0,))  # saturated laws take longer
    namespace: dict[str, object] = {"__name__": "page"}
    for line, code in fenced(PAGES[page], "python"):
        # Blank lines first, so that a traceback names the page's own line.
        exec(compile("\n" * line + code, page, "exec"), namespace)


@needs_docs
@pytest.mark.slow
def test_the_task_of_the_guide_trains(tmp_path):
    """As a script, in the runs of a sweep, which are processes of their own.

    Tests of tasks and of sweeps run both apart, in one process.
    """
    blocks = [code for _, code in fenced(PAGES["docs/guides/task.md"], "python")]
    (script,) = (code for code in blocks if "register(" in code)
    (tmp_path / "my_task.py").write_text(script, encoding="utf-8")
    small = (*SMALL, "task.horizon=10", "figures=false", "hydra.launcher.n_jobs=2")
    command = [sys.executable, "my_task.py", "-m", "task=pole", "seed=1,2", *small]
    sweep = ended(*command, "hydra.sweep.dir=sweep", cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert "2 out of   2" in sweep.stderr
    assert "deviation, none" not in sweep.stderr, "a run's own bar"
    assert "closed gap" not in sweep.stdout, "a run's own table"
    summary = json.loads((tmp_path / "sweep/none-identified-seed2/summary.json").read_text())
    assert (summary["task"], summary["seed"], summary["updates"]) == ("pole", 2, 4)
    assert summary["J_true_model"] < summary["J_start"]


@needs_docs
def test_every_test_that_a_page_names_exists():
    text = PAGES["docs/reliability/measured.md"]
    table = text.split("<!-- pytorch -->")[1].split("<!-- /pytorch -->")[0]
    named = re.findall(r"^(\d+)\. `(tests/[\w/]+\.py)::(test_\w+)`$", table, re.MULTILINE)
    assert {number for number, _, _ in named} == {*re.findall(r"\[(\d+)\]", table)}
    for _, path, test in named:
        source = (ROOT / path).read_text(encoding="utf-8")
        assert f"\ndef {test}(" in source, f"{path}::{test}"


@needs_docs
def test_every_file_and_module_that_a_page_names_exists():
    for page, text in PAGES.items():
        for path in re.findall(r"(?<![\w/])(?:torch_qpmpc|tests|configs|docs)/[\w/]+\.\w+", text):
            assert "NAME" in path or (ROOT / path).exists(), f"{page}: {path}"
        for module in re.findall(r"^::: ([\w.]+)", text, re.MULTILINE):
            assert importlib.util.find_spec(module) is not None, f"{page}: {module}"


@needs_docs
def test_the_readmes_numbers_are_those_of_the_pages():
    readme = PAGES["README.md"]
    excerpts = re.findall(r"^<!-- excerpt (.+) -->\n+((?:\|.*\n)+)", readme, re.MULTILINE)
    assert len(excerpts) == 2
    for page, excerpt in excerpts:
        cells = {*re.split(r" *\| *", PAGES[page].replace("\n", "|"))}
        _, _, *rows = excerpt.splitlines()
        for row in rows:
            _, *numbers = row.strip("| ").split(" | ")
            assert {*numbers} <= cells, f"{page}: {row}"


GUIDES = [x for x in PAGES if x.startswith("docs/guides/") and "troubleshooting" not in x]


@pytest.mark.parametrize("page", GUIDES)
def test_a_guide_is_short_begins_with_a_script_and_has_a_picture(page):
    text = PAGES[page]
    assert len(text.split()) <= 1000
    first, *_ = re.findall(r"^(#{2,}|```python|```bash)", text, re.MULTILINE)
    assert first.startswith("```")
    assert len(text.split("```")[0].split()) <= 70
    shown = re.findall(r"!\[.+\]\((.+?)\)", text)
    assert shown
    assert all((DOCS / "guides" / picture).exists() for picture in shown)


@needs_docs
def test_the_documentation_is_short():
    pages = [text for page, text in PAGES.items() if page.startswith("docs/")]
    assert len(pages) <= 40
    assert sum(len(text.split()) for text in pages) <= 23_000
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split()) <= 400


@needs_docs
def test_the_readme_is_short_and_its_links_lead_somewhere():
    readme = PAGES["README.md"]
    assert len(readme.splitlines()) <= 110
    assert len(readme.split()) <= 600
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", readme):
        assert target.startswith("https://") or (ROOT / target).exists(), target


@needs_docs
def test_each_configuration_key_has_a_meaning_and_a_value(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    for name in [name for name, task in TASKS.items() if task.defaults is not None]:
        monkeypatch.delitem(TASKS, name)  # of other tests
    reference = importlib.import_module("keys")
    for key, settings in reference.settings().items():
        assert settings, key
        assert key.endswith(".name") or reference.meaning(settings), key
    page = reference.page()
    assert "| `task.horizon` | N | `10`; " in page


@needs_docs
def test_the_reference_has_every_public_name():
    index = PAGES["docs/api/index.md"]
    assert {*re.findall(r"`qm\.(\w+)`", index)} - {"envs"} == {*torch_qpmpc.__all__}


@pytest.mark.parametrize("name", EXAMPLES)
def test_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    )
    assert results.attempted
    assert results.failed == 0, f"{results.failed} of {results.attempted} examples of {name}"
