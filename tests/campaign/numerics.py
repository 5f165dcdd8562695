"""Solvers' accuracy and gradient errors: ``python -m tests.campaign.numerics``.

Away from kinks every row of the known QPs is clearly active or clearly not; near one, a hard row is
`NEAR` to its bound; at one, it is at its bound with no multiplier, and the gradient has to be
between the one-sided ones. All along a direction through q, b and the bounds.
"""

import argparse
import sys
from dataclasses import replace

import torch
from torch import Tensor

from tests.benchmarks.table import DOCS, publish, table
from tests.problems import KnownQP, known_qp, normal
from torch_qpmpc import QuadraticProgram, solve_qp
from torch_qpmpc.qp.program import TOLERANCE
from torch_qpmpc.qp.solvers import BACKENDS

PAGE = DOCS / "reliability" / "measured.md"
#: Step of the finite differences, and a distance to kinks that they do not cross.
STEP, NEAR = 1e-6, 1e-4
COUNT, SEEDS = 32, 6
SOFT = ("inside", "at_lower", "at_upper", "below", "above")
#: Kinds of the hard rows, apart from those "away" from, "near" or "at" a kink.
KINDS = {"away": ("at_upper",), "near": ("weak_upper",), "at": ("weak_upper",)}
NAMES = (
    "residual",
    "value",
    "z",
    "value, float32",
    "z, float32",
    *(
        f"gradient of {part}, {place.replace('away', 'away from')} kinks"
        for part in ("value", "z")
        for place in KINDS
    ),
)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.numerics", description=__doc__)
    parser.add_argument("--solver", nargs="*", default=list(BACKENDS))
    parser.add_argument("--write", action="store_true", help="write the table to the page")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    rows = [measure(solver) for solver in options.solver]
    lines = [[name, *(row[i] for row in rows)] for i, name in enumerate(NAMES)]
    text = table(["largest relative error", *options.solver], lines)
    publish(text, "numerics", options.write, PAGE)


def measure(solver: str) -> list[str]:
    double, single = (accuracy(solver, dtype) for dtype in (torch.float64, torch.float32))
    gradients = [gradient(solver, part, place) for part in ("value", "z") for place in KINDS]
    figures = (*double, *single[1:], *gradients)
    return [f"{figure:.0e}" for figure in figures]


def accuracy(solver: str, dtype: torch.dtype) -> tuple[float, float, float]:
    """Return the largest residual and relative errors of value and z of well-posed QPs."""
    worst = [0.0, 0.0, 0.0]
    for seed in range(SEEDS):
        known = known_qp(seed, batch=(COUNT,), dtype=dtype)
        solution = solve_qp(known.qp, known.fixed, solver=solver)
        found = (
            solution.residual,
            error(solution.value, known.value, 1),
            error(solution.z, known.z, 0),
        )
        worst = [max(w, float(f.max())) for w, f in zip(worst, found, strict=True)]
    assert worst[0] <= TOLERANCE
    return worst[0], worst[1], worst[2]


def error(found: Tensor, exact: Tensor, floor: float) -> Tensor:
    return (found - exact).abs().amax() / exact.abs().amax().clamp(min=floor)


def gradient(solver: str, part: str, place: str) -> float:
    """Return the largest error of a directional derivative, relative to the largest derivative.

    At a kink, the error is the distance from the interval between the one-sided differences.
    """
    worst = 0.0
    for seed in range(SEEDS):
        known = placed(known_qp(seed, batch=(COUNT,), soft=SOFT, hard=KINDS[place]), place)
        moves = {name: normal(*vars(known.qp)[name].shape, seed=i) for i, name in enumerate("qb")}
        moves["ub"] = moves["lb"] = normal(*known.qp.ub.shape, seed=9)
        weight = normal(*known.z.shape, seed=8)

        def along(step: float | Tensor, by: str, known=known, moves=moves, weight=weight):
            shifted = {name: getattr(known.qp, name) + step * move for name, move in moves.items()}
            qp = QuadraticProgram(**(vars(known.qp) | shifted), check_values=False)
            solution = solve_qp(qp, known.fixed, solver=by)
            return solution.value if part == "value" else (solution.z * weight).sum(-1)

        leaf = torch.zeros(COUNT, 1).double().requires_grad_()
        (slope,) = torch.autograd.grad(along(leaf, solver).sum(), leaf)
        # Differences magnify the solver's errors: the most accurate solver computes them for all.
        ahead, here, behind = (along(step, "torch").detach() for step in (STEP, 0.0, -STEP))
        one_sided = torch.stack(((ahead - here) / STEP, (here - behind) / STEP))
        if place == "at":
            low, high = one_sided.amin(0), one_sided.amax(0)
        else:
            low = high = one_sided.mean(0)
        off = slope[:, 0] - slope[:, 0].clamp(low, high)
        worst = max(worst, float(off.abs().max() / one_sided.abs().max().clamp(min=1)))
    return worst


def placed(known: KnownQP, place: str) -> KnownQP:
    """Move weakly active rows away from their bounds by `NEAR` where "near" a kink."""
    if place != "near":
        return known
    weak = (known.lam == 0) & known.qp.w.isinf()
    ub = torch.where(weak, known.qp.ub + NEAR, known.qp.ub)
    return replace(known, qp=replace(known.qp, ub=ub))


if __name__ == "__main__":
    sys.exit(main())
