"""Solving in a forked child, where OpenMP's threads do not exist and torch would wait for them."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")
_forked = False


def _mark() -> None:
    global _forked
    _forked = True


os.register_at_fork(after_in_child=_mark)


@contextmanager
def serial_if_forked() -> Iterator[None]:
    """Use one thread of torch in a forked child, and restore the child's own number."""
    if not _forked:
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def serially_if_forked(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function that the compiler may trace within `serial_if_forked`."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        if not _forked:
            return function(*args, **kwargs)
        with serial_if_forked():
            return function(*args, **kwargs)

    return wrapped
