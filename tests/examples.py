"""The tasks in docs/examples, which register themselves."""

import functools
import importlib.util
import sys
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "docs" / "examples"


@functools.cache
def example(name: str) -> Any:
    """Return the module of docs/examples/NAME.py; ``task=NAME`` is a choice afterwards."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
