"""Tables of mistakes as tests."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import pytest

from torch_qpmpc import QPError


def refused(*rows: tuple[Any, ...]) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Make a function the test of a table: its call with each row raises the row's last entry.

    This is a pattern that a `QPError` begins with. Parameters after those of a row are fixtures.
    """

    def make(call: Callable[..., Any]) -> Callable[..., None]:
        signature = inspect.signature(call)
        names = [*signature.parameters][: len(rows[0]) - 1]

        @pytest.mark.parametrize((*names, "message"), rows)
        @functools.wraps(call)
        def test(message: str, **arguments: Any) -> None:
            with pytest.raises(QPError, match=f"^{message}"):
                call(**arguments)

        parameter = inspect.Parameter("message", inspect.Parameter.KEYWORD_ONLY)
        parameters = [*signature.parameters.values(), parameter]
        test.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportAttributeAccessIssue] - of the fixtures
        return test

    return make
