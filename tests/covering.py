"""Fewer combinations of parameters than all, where a test depends on at most two of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any


def covering(combinations: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """A few of the combinations that have every pair of choices which one of them has."""

    def pairs(combination: tuple[str, ...]) -> set[Any]:
        return set(itertools.combinations(enumerate(combination), 2))

    given, chosen = list(combinations), []
    left = set().union(*map(pairs, given))
    while left:
        chosen.append(max(given, key=lambda combination: len(pairs(combination) & left)))
        left -= pairs(chosen[-1])
    return chosen
