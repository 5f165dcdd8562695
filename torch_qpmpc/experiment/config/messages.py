"""From pydantic's errors to the package's own: the key, what came, and what is expected."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config.model import Config
from torch_qpmpc.experiment.fields import Expected
from torch_qpmpc.experiment.tasks import TASKS

#: The order in which errors are reported, by pydantic's types: a misspelt key before the missing
#: one, values (1) before missing keys, and conflicts last.
ORDER = {"extra_forbidden": 0, "missing": 2, "union_tag_not_found": 2, "value_error": 3}


def first_of(error: ValidationError) -> QPError:
    """Write the first error in a sentence."""
    return _in_a_sentence(min(error.errors(), key=lambda found: ORDER.get(found["type"], 1)))


def _in_a_sentence(error: Any) -> QPError:
    kind, value, path = error["type"], error["input"], error["loc"]
    if kind == "value_error" and isinstance(error["ctx"]["error"], QPError):
        return error["ctx"]["error"]
    if len(path) > 1 and Config.model_fields[path[0]].discriminator:
        path = path[:1] + path[2:]  # in between is the name of the choice
    key, known = ".".join(map(str, path)), keys()
    if kind == "extra_forbidden":
        if key in known:
            return QPError.expected(key, "a key of another choice", f"a key of this {path[0]}")
        return unknown_key(next(iter(flatten(value, key)), key), known)
    if kind.startswith("union_tag"):
        key, value = f"{key}.name", value.get("name")
    got = "nothing" if kind in ("missing", "union_tag_not_found") else repr(value)
    sentence = known.get(key, "its keys, as in configs/")
    return QPError.expected(key, got, sentence or f"an allowed value ({error['msg']})")


def unknown_key(key: str, known: Mapping[str, str]) -> QPError:
    """Make the error of a misspelt key, with the nearest one."""
    close = difflib.get_close_matches(key, known, n=1)
    hint = f"Did you mean {close[0]}?" if close else "See configs/config.yaml."
    return QPError.expected(key, "an unknown key", "a key of configs/", hint)


def keys() -> dict[str, str]:
    """Return every dotted key, of all choices, with what its value must be."""
    return dict(_keys_of(Config))


def _keys_of(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, info in model.model_fields.items():
        key, kinds = f"{prefix}{name}", (info.annotation, *get_args(info.annotation))
        groups = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        names = []
        if key == "task":
            groups, names = [task.settings for task in TASKS.values()], list(TASKS)
        elif info.discriminator:
            names = [get_args(group.model_fields["name"].annotation)[0] for group in groups]
        for group in groups:
            yield from _keys_of(group, f"{key}.")
        if names:
            yield f"{key}.name", f"one of {', '.join(names)}"
        if not groups:
            yield key, next((x.sentence for x in info.metadata if isinstance(x, Expected)), "")


def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Make one mapping of nested ones, with dotted keys."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    pairs = (flatten(value, f"{prefix}.{key}".lstrip(".")) for key, value in tree.items())
    return {key: value for pair in pairs for key, value in pair.items()}
