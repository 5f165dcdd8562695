"""Proofs about a policy on a set of states, by mixed-integer programs: worst cases, invariance."""

from torch_qpmpc.proofs.invariant import InvariantSet, invariant_set
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
    "InvariantSet",
    "Plant",
    "Polytope",
    "invariance",
    "invariant_set",
    "largest_difference",
    "largest_violation",
]
