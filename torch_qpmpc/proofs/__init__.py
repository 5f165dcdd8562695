"""Proofs about a policy on a set of states, as mixed-integer programs: worst cases, invariance."""

from torch_qpmpc.proofs.polytope import Polytope
from torch_qpmpc.proofs.questions import (
    Answer,
    Plant,
    invariance,
    largest_difference,
    largest_violation,
)

__all__ = [
    "Answer",
    "Plant",
    "Polytope",
    "invariance",
    "largest_difference",
    "largest_violation",
]
