"""Error messages of the configuration, made from pydantic's: key, value and expected value."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.config.model import Config
from torch_qpmpc.experiment.fields import Expected
from torch_qpmpc.experiment.tasks import TASKS

#: Rank of pydantic's error types: misspelt keys come first, then invalid values (1), missing keys
#: and conflicts. Only the first error is reported.
ORDER = {"extra_forbidden": 0, "missing": 2, "union_tag_not_found": 2, "value_error": 3}


def first_error(error: ValidationError) -> QPError:
    """Make a `QPError` of the first error by `ORDER`."""
    return _make_error(min(error.errors(), key=lambda details: ORDER.get(details["type"], 1)))


def _make_error(error: Any) -> QPError:
    kind, value, path = error["type"], error["input"], error["loc"]
    if kind == "value_error" and isinstance(error["ctx"]["error"], QPError):
        return error["ctx"]["error"]
    if len(path) > 1 and Config.model_fields[path[0]].discriminator:
        path = path[:1] + path[2:]  # pydantic inserts the name of the choice
    key, known = ".".join(map(str, path)), keys()
    if kind == "extra_forbidden":
        if key in known:
            return QPError.expected(key, "a key of another choice", f"a key of this {path[0]}")
        return unknown_key(next(iter(flatten(value, key)), key), known)
    if kind.startswith("union_tag"):
        key, value = f"{key}.name", value.get("name")
    got = "nothing" if kind in ("missing", "union_tag_not_found") else repr(value)
    phrase = known.get(key, "its keys, as in configs/")
    return QPError.expected(key, got, phrase or f"an allowed value ({error['msg']})")


def unknown_key(key: str, known: Mapping[str, str]) -> QPError:
    """Make the error of an unknown key, with the nearest known one."""
    groups = {name.partition(".")[0] for name in known} if "." not in key else ()
    close = difflib.get_close_matches(key, [*groups, *known], n=1)
    hint = f"Did you mean {close[0]}?" if close else "See configs/config.yaml."
    return QPError.expected(key, "an unknown key", "a key of configs/", hint)


def keys() -> dict[str, str]:
    """Return every dotted key of all choices, with a phrase for its allowed values."""
    return dict(_keys_of(Config))


def _keys_of(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, info in model.model_fields.items():
        key, kinds = f"{prefix}{name}", (info.annotation, *get_args(info.annotation))
        groups = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel)]
        names = []
        if key == "task":
            groups, names = [task.settings for task in TASKS.values()], list(TASKS)
        elif info.discriminator:
            names = [
                name for group in groups for name in get_args(group.model_fields["name"].annotation)
            ]
        for group in groups:
            yield from _keys_of(group, f"{key}.")
        if names:
            yield f"{key}.name", f"one of {', '.join(names)}"
        if not groups:
            yield key, next((x.phrase for x in info.metadata if isinstance(x, Expected)), "")


def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings into one with dotted keys."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    pairs = (flatten(value, f"{prefix}.{key}".lstrip(".")) for key, value in tree.items())
    return {key: value for pair in pairs for key, value in pair.items()}
