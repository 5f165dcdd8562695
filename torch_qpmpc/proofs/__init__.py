"""Proofs about a policy on a set of states: worst cases and invariance."""

from torch_qpmpc.proofs.invariant import InvariantSet, invariant_set
from torch_qpmpc.proofs.plant import Plant, Polytope
from torch_qpmpc.proofs.questions import Answer, invariance, largest_difference, largest_violation

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
