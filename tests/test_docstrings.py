"""The reference is complete: every public name, its methods and its arguments are documented.

What is missing is listed by name. An argument may be described under ``Args`` or in the text, where
it is a word ``in backticks``, part of a term such as Q(s, a), or followed by its shape.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import torch_qpmpc

NAMES = {name: getattr(torch_qpmpc, name) for name in torch_qpmpc.__all__}
NAMES |= {f"envs.{name}": getattr(torch_qpmpc.envs, name) for name in torch_qpmpc.envs.__all__}
#: Where a reader starts: these show how they are used.
CHIEF = (
    "DeviationPenalty",
    "GaussNewton",
    "QPActorValueOperator",
    "QPMPC",
    "QPQLearningLoss",
    "QuadraticProgram",
    "SystemIdentificationPenalty",
    "envs.GymnasiumPlant",
    "envs.LinearSystem",
    "envs.PointMassEnv",
    "solve_qp",
)
SECTIONS = "Args|Attributes|Returns|Raises|Yields|Example|Examples|References|Note"


def is_ours(thing: Any) -> bool:
    return getattr(thing, "__module__", "").startswith("torch_qpmpc")


def function_of(member: Any) -> Callable[..., Any] | None:
    """The function behind a method, a property or a decorated function, if it is one."""
    member = getattr(member, "__func__", member)
    member = member.fget if isinstance(member, property) else member
    return inspect.unwrap(member) if inspect.isfunction(member) else None


def arguments(function: Callable[..., Any]) -> list[str]:
    names = inspect.signature(function).parameters
    return [name for name in names if name not in ("self", "cls") and not name.startswith("_")]


def methods(cls: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    """The public methods and properties of a class, but for plain overrides of a library's."""
    for name in sorted({name for base in cls.__mro__ if is_ours(base) for name in vars(base)}):
        function = function_of(inspect.getattr_static(cls, name))
        if name.startswith("_") or function is None or not is_ours(function):
            continue
        theirs = [vars(b)[name] for b in cls.__mro__ if not is_ours(b) and name in vars(b)]
        same = theirs and inspect.isfunction(function_of(theirs[0]))
        if not (same and arguments(function_of(theirs[0])) == arguments(function)):  # pyright: ignore[reportArgumentType] - is one
            yield name, function


def sections(doc: str) -> dict[str, str]:
    """The text of each section, of the part before the first as ""."""
    parts = re.split(rf"^({SECTIONS}):\n", doc, flags=re.MULTILINE)
    return {"": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}


def entries(section: str) -> dict[str, str]:
    """``{"A": text, "B": text}`` of the lines ``A, B: text`` and those indented below them."""
    found: dict[str, str] = {}
    for entry in re.split(r"^ {4}(?=\S)", section, flags=re.MULTILINE):
        names, _, text = entry.partition(":")
        found |= dict.fromkeys(re.findall(r"\w+", names), text.strip())
    return found


def is_described(name: str, doc: str) -> bool:
    parts = sections(doc)
    if any(entries(parts.get(section, "")).get(name) for section in ("Args", "Attributes")):
        return True
    text, word = parts[""], rf"(?<![\w'.]){name}(?!\w)"
    quoted = " ".join(re.findall(r"``(.+?)``", text, re.DOTALL))
    terms = " ".join(re.findall(r"\w\(([^()]*)\)", text))
    return bool(re.search(word, f"{quoted} {terms}") or re.search(rf"{word}\s+``\(", text))


def raises(function: Callable[..., Any], owner: type | None, checks: bool) -> bool:
    """True if a function, or a private one that it calls, raises QPError; or checks arguments."""
    seen, queue = set(), [function]
    while queue:
        function = queue.pop()
        seen.add(function)
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
        except OSError:  # a dataclass's __init__
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Raise) and "QPError" in ast.unparse(node):
                return True
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            if checks and called.split(".")[-1].startswith("check_"):
                return True
            name = called.removeprefix("self.")
            if not name.startswith("_") or name.startswith("__"):
                continue
            helper = getattr(owner, name, None) if "self." in called else None
            helper = function_of(helper or function.__globals__.get(name))
            if helper is not None and helper not in seen:
                queue.append(helper)
    return False


def of_function(name: str, function: Callable[..., Any], owner: type | None = None) -> list[str]:
    """What the docstring of a function or a method lacks."""
    # An override may leave the description to what it overrides.
    bases = [vars(base).get(function.__name__) for base in getattr(owner, "__mro__", ())[1:]]
    overridden = [base for base in bases if base is not None and is_ours(base)]
    docs = [inspect.cleandoc(x.__doc__) for x in (function, *overridden) if x.__doc__]
    missing = of_summary(name, docs[0] if docs else "")
    for argument in arguments(function) if docs else ():
        if not any(is_described(argument, doc) for doc in docs):
            missing.append(f"{name}: argument {argument}")
    if raises(function, owner, checks=False) and not any(map(names_its_error, docs)):
        missing.append(f"{name}: Raises: QPError")
    return missing


def names_its_error(doc: str) -> bool:
    return "QPError" in sections(doc).get("Raises", "")


def of_summary(name: str, doc: str) -> list[str]:
    first = doc.split("\n\n")[0]
    if not doc:
        return [f"{name}: docstring"]
    return [] if len(first) > 15 and first[-1] in ".:" else [f"{name}: a sentence as summary"]


def of_class(name: str, cls: type) -> list[str]:
    """What the docstrings of a class and of its public methods lack."""
    doc = inspect.cleandoc(cls.__doc__ or "")
    missing = of_summary(name, doc)
    if issubclass(cls, enum.Enum):
        return missing + [f"{name}: member {x}" for x in cls.__members__ if x not in doc]
    makers = [function_of(vars(cls).get(x)) for x in ("__init__", "__post_init__")]
    makers = [maker for maker in makers if maker is not None]
    expected = dict.fromkeys(x for maker in makers for x in arguments(maker))
    if dataclasses.is_dataclass(cls):
        expected |= dict.fromkeys(field.name for field in dataclasses.fields(cls))
    docs = [inspect.cleandoc(b.__doc__) for b in cls.__mro__ if is_ours(b) and b.__doc__]
    for argument in expected:
        if not any(is_described(argument, doc) for doc in docs):
            missing.append(f"{name}: argument {argument}")
    if any(raises(x, cls, checks=True) for x in makers) and not names_its_error(doc):
        missing.append(f"{name}: Raises: QPError")
    for method, function in methods(cls):
        if function.__qualname__.startswith(f"{cls.__name__}."):  # where it is defined
            missing += of_function(f"{name}.{method}", function, cls)
    return missing


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_is_documented(name):
    public = NAMES[name]
    missing = of_class(name, public) if inspect.isclass(public) else of_function(name, public)
    if name in CHIEF and ">>>" not in sections(inspect.getdoc(public) or "").get("Example", ""):
        missing.append(f"{name}: Example")
    assert not missing, "missing in docstrings:\n" + "\n".join(missing)
