"""The reference is complete: every public name, its methods and its arguments are documented."""

import dataclasses
import enum
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import torch_qpmpc

NAMES = {name: getattr(torch_qpmpc, name) for name in torch_qpmpc.__all__}
NAMES |= {f"envs.{name}": getattr(torch_qpmpc.envs, name) for name in torch_qpmpc.envs.__all__}
#: Where a reader starts: these show how they are used.
CHIEF = ("DeviationPenalty", "GaussNewton", "QPActorValueOperator", "QPMPC", "QPQLearningLoss")
CHIEF += ("QuadraticProgram", "SystemIdentificationPenalty", "solve_qp", "envs.GymnasiumPlant")
CHIEF += ("envs.LinearSystem", "envs.LinearSystemEnv")


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


def is_described(word: str, doc: str) -> bool:
    """True for an entry of a section, and in the text for a word in backticks or of Q(s, a)."""
    text = re.split(r"^(?:Args|Attributes|Returns|Raises):", doc, flags=re.MULTILINE)[0]
    entry = rf"^ *(?:\w+, )*{word}(?:, \w+)*:"
    term = rf"``[^`]*\b{word}\b[^`]*``|\w\([^()]*\b{word}\b[^()]*\)|\b{word}\s+``\("
    return bool(re.search(entry, doc, re.MULTILINE) or re.search(term, text))


def lacking(name: str, docs: list[str | None], expected: list[str]) -> Iterator[str]:
    found = [inspect.cleandoc(doc) for doc in docs if doc]
    first = found[0].split("\n\n")[0] if found else ""
    if len(first) <= 15 or first[-1] not in ".:":
        yield f"{name}: a sentence as summary"
    for word in expected:
        if not any(is_described(word, doc) for doc in found):
            yield f"{name}: argument {word}"


def of_class(name: str, cls: type) -> Iterator[str]:
    ours = [base for base in cls.__mro__ if is_ours(base)]
    makers = [function_of(vars(cls).get(x)) for x in ("__init__", "__post_init__")]
    expected = [x for maker in makers if maker is not None for x in arguments(maker)]
    if dataclasses.is_dataclass(cls):
        expected += [field.name for field in dataclasses.fields(cls)]
    if issubclass(cls, enum.Enum):
        expected = [*cls.__members__]
    yield from lacking(name, [base.__doc__ for base in ours], expected)
    for method, member in vars(cls).items():
        function = function_of(member)
        if method.startswith("_") or function is None or not is_ours(function):
            continue
        # What overrides a method of the package, or a library's as it is, may leave it to that.
        bases = [function_of(vars(base).get(method)) for base in cls.__mro__]
        if not any(x and not is_ours(x) and arguments(x) == arguments(function) for x in bases):
            docs = [x.__doc__ for x in bases if x and is_ours(x)]
            yield from lacking(f"{name}.{method}", docs, arguments(function))


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_is_documented(name):
    public = NAMES[name]
    if inspect.isclass(public):
        missing = [*of_class(name, public)]
    else:
        missing = [*lacking(name, [public.__doc__], arguments(public))]
    if name in CHIEF and ">>>" not in (inspect.getdoc(public) or ""):
        missing.append(f"{name}: Example")
    assert not missing, "missing in docstrings:\n" + "\n".join(missing)
