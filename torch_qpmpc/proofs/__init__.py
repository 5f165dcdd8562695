"""Proofs about a policy on a set of states: worst cases, invariance, its explicit law."""

from torch_qpmpc.proofs.choices import Region
from torch_qpmpc.proofs.explicit import ExplicitLaw, explicit_law
from torch_qpmpc.proofs.invariant import InvariantSet, invariant_set
from torch_qpmpc.proofs.plant import Plant
from torch_qpmpc.proofs.polytope import Polytope
from torch_qpmpc.proofs.questions import (
    Answer,
    invariance,
    largest_difference,
    largest_violation,
)
from torch_qpmpc.proofs.regions import grown_set, largest_increase
from torch_qpmpc.proofs.tree import SearchTree

__all__ = [
    "Answer",
    "ExplicitLaw",
    "InvariantSet",
    "Plant",
    "Polytope",
    "Region",
    "SearchTree",
    "explicit_law",
    "grown_set",
    "invariance",
    "invariant_set",
    "largest_difference",
    "largest_increase",
    "largest_violation",
]
