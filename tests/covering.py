"""Covering sets of parameter combinations: every pair of choices, but not every combination."""

import itertools
from collections.abc import Iterable
from typing import Any


def covering(combinations: Iterable[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """Choose a few combinations that cover every pair of choices in ``combinations``."""

    def pairs(combination: tuple[Any, ...]) -> set[Any]:
        return set(itertools.combinations(enumerate(combination), 2))

    given, chosen = list(combinations), []
    left = set().union(*map(pairs, given))
    while left:
        chosen.append(max(given, key=lambda combination: len(pairs(combination) & left)))
        left -= pairs(chosen[-1])
    return chosen
