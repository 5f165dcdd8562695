"""Random QPs with known solutions, built from KKT points, and random QPMPCs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc import QPMPC, QuadraticProgram
from torch_qpmpc.analysis.structure import PredictionForm, prediction_form
from torch_qpmpc.mpc.layout import banded_matrix
from torch_qpmpc.qp.kernels import sample
from torch_qpmpc.qp.kernels.batched import multiply
from torch_qpmpc.qp.kernels.sample import Terms
from torch_qpmpc.qp.pipeline.arrays import SoftQPs, Theta, to_tensor
from torch_qpmpc.qp.pipeline.batch import Programs
from torch_qpmpc.qp.pipeline.condensing import Reduced
from torch_qpmpc.qp.solvers import BackendSolution

#: Positions of a row at the solution: inside its bounds, at one, or (if soft) beyond one.
SOFT_ROWS = ("inside", "at_lower", "at_upper", "below", "above", "equality", "no_upper", "free")
HARD_ROWS = ("inside", "at_lower", "at_upper", "equality", "no_upper")

#: Rows at a bound with zero multiplier, and soft rows at a bound with multiplier w and zero slack,
#: the threshold of the exact penalty.
WEAK = ("weak_lower", "weak_upper")
BRINK = ("brink_lower", "brink_upper")

#: Soft rows on (x_k, u_k) and on x_N.
MIXED: dict[str, Any] = {
    "constraints": ([[1.0, 0.5, 1.0], [0.0, 1.0, -1.0]], [-0.8, -torch.inf], [0.8, 0.6]),
    "terminal_constraints": ([[1.0, 1.0]], [-0.4], [0.3]),
}


def normal(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


@torch.no_grad()
def central_difference(
    function: Callable[[], Tensor], leaf: Tensor, direction: Tensor, step: float
) -> Tensor:
    ends = []
    for sign in (1, -1):
        leaf.add_(sign * step * direction)
        ends.append(function())
        leaf.sub_(sign * step * direction)
    return (ends[0] - ends[1]) / (2 * step)


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def model_form(
    A: Tensor, B: Tensor, N: int, offset: Tensor | None = None, E: Tensor | None = None
) -> PredictionForm:
    """Make the prediction form of a model with d, one or one per stage."""
    n_x, n_d = A.shape[-2], 0 if E is None else E.shape[-1]
    b = None if offset is None else -offset.expand(N, n_x).flatten()
    C = banded_matrix(A, B, N, E)
    return prediction_form(C, n_x, B.shape[-1], b, n_d)


def predict(form: PredictionForm, p: Tensor, U: Tensor) -> Tensor:
    """Return x_1, .., x_N ``(*batch, N, n_x)`` from p and U ``(*batch, N, n_u)``."""
    X = times(form.Phi, p) + times(form.Gamma, U.flatten(-2)) + form.phi
    return X.unflatten(-1, (form.layout.horizon, form.layout.n_x))


@dataclass(frozen=True)
class KnownQP:
    """A QP with its fixed entries and its solution; ``lam = eta - upsilon``."""

    qp: QuadraticProgram
    fixed: Tensor
    value: Tensor
    z: Tensor
    sigma: Tensor
    chi: Tensor
    lam: Tensor
    xi: Tensor

    @property
    def upsilon(self) -> Tensor:
        return (-self.lam).clamp(min=0)

    @property
    def eta(self) -> Tensor:
        return self.lam.clamp(min=0)


def known_qp(
    seed: int,
    *,
    batch: tuple[int, ...] = (),
    matrices: tuple[int, ...] = (),
    n_z: int = 12,
    n_c: int = 3,
    n_f: int = 2,
    soft: tuple[str, ...] = SOFT_ROWS,
    hard: tuple[str, ...] = HARD_ROWS,
    weight: float = 5.0,
    rank: int | None = None,
    H: Tensor | None = None,
    C: Tensor | None = None,
    G: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
) -> KnownQP:
    """Make a QP with rows of the kinds ``soft`` and ``hard``, ordered randomly in each element.

    H, C and G are drawn with the batch shape ``matrices`` unless given. H has the given ``rank``,
    or is positive definite. With H positive definite and C of full row rank, the solution is
    unique, and without `WEAK` or dependent rows, so are the multipliers.
    """
    generator = torch.Generator().manual_seed(seed)

    def gauss(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    rows = [(kind, False) for kind in soft] + [(kind, True) for kind in hard]
    n_g = len(rows)
    order = uniform(0, 1, *batch, n_g).argsort(-1)

    def which(*kinds: str) -> Tensor:
        return torch.tensor([kind in kinds for kind, _ in rows], dtype=torch.bool)[order]

    if H is None:
        factor = gauss(*matrices, n_z, n_z if rank is None else rank)
        H = factor @ factor.mT / n_z
        if rank is None:
            H = H + torch.eye(n_z, dtype=torch.float64)
    C = gauss(*matrices, n_c, n_z) if C is None else C
    G = gauss(*matrices, n_g, n_z) if G is None else G

    z, chi, xi = gauss(*batch, n_z), gauss(*batch, C.shape[-2]), gauss(*batch, n_f)
    y = times(G, z)
    is_hard = torch.tensor([hard for _, hard in rows], dtype=torch.bool)[order]
    w = uniform(0.5, 1.5, *batch, n_g).mul(weight).masked_fill(is_hard, torch.inf)

    pulled = which("at_upper", "above", "brink_upper").double()
    sign = pulled - which("at_lower", "below", "brink_lower").double()
    sign = torch.where(which("equality"), gauss(*batch, n_g).sign(), sign)
    saturated = which("below", "above", *BRINK)
    share = torch.where(saturated, 1.0, uniform(0.2, 0.8, *batch, n_g))
    lam = sign * share * torch.where(is_hard, weight, w)
    gap, beyond = uniform(0.5, 2.0, *batch, n_g), uniform(0.1, 1.0, *batch, n_g)
    lb, ub = y - gap, y + gap
    lb = torch.where(which("at_lower", "weak_lower", "brink_lower", "equality"), y, lb)
    ub = torch.where(which("at_upper", "weak_upper", "brink_upper", "equality"), y, ub)
    lb = torch.where(which("below"), y + beyond, lb)
    ub = torch.where(which("below"), lb + gap, ub)
    ub = torch.where(which("above"), y - beyond, ub)
    lb = torch.where(which("above"), ub - gap, lb)
    lb = lb.masked_fill(which("free"), -torch.inf)
    ub = ub.masked_fill(which("free", "no_upper"), torch.inf)
    sigma = torch.where(which("below", "above"), beyond, 0.0)

    gradient = times(H, z) + times(G.mT, lam) + times(C.mT, chi)
    gradient[..., :n_f] += xi
    q, c = -gradient, gauss(*batch)
    value = 0.5 * (z * times(H, z)).sum(-1) + (q * z).sum(-1) + c
    value = value + (w.masked_fill(is_hard, 0.0) * sigma).sum(-1)
    H, q, c, C, b, G, lb, ub, w = (x.to(dtype) for x in (H, q, c, C, times(C, z), G, lb, ub, w))
    return KnownQP(
        QuadraticProgram(H, q, c, C, b, G, lb, ub, w),
        z[..., :n_f].to(dtype),
        *(tensor.to(dtype) for tensor in (value, z, sigma, chi, lam, xi)),
    )


def programs_of(known: KnownQP) -> Programs:
    """Convert a known QP to the pipeline's input."""
    return Programs.of(*known.qp.tensors(), known.fixed)[0]


def within(lam: Tensor, lb: Tensor, ub: Tensor, w: Tensor) -> Tensor:
    """Return lam within [-w, w], on the side of a bound, as candidates are before the judge."""
    inside = torch.where(lam.isnan(), lam, lam.clamp(-w, w))
    return torch.where(torch.where(lam > 0, ub.isinf(), (lam < 0) & lb.isinf()), 0.0, inside)


def certified(p: Programs, *claim: Tensor) -> tuple[Tensor, ...]:
    """Return value, residual and error of a value of the ``claim`` z, lam, chi, xi."""
    z, lam, chi, xi = claim
    group, theta = torch.from_numpy(p.group), Theta._make(map(torch.from_numpy, p.theta))
    lam = within(lam, theta.lb, theta.ub, theta.w)
    Hz, y, Cz = (multiply(x, group, z) for x in (theta.H, theta.G, theta.C))
    G_lam, C_chi = multiply(theta.G.mT, group, lam), multiply(theta.C.mT, group, chi)
    left = Hz + theta.q + G_lam + C_chi
    left[:, : xi.shape[-1]] += xi
    terms = Terms._make(x.contiguous().numpy() for x in (Hz, G_lam, C_chi, left, y, Cz))
    qps = p.group, p.fixed, p.prepared.held(p.n_f)
    found = sample.judge(z.numpy(), lam.numpy(), chi.numpy(), *qps, terms)
    return (*map(torch.from_numpy, found),)


def reduced_of(known: KnownQP) -> Reduced:
    """Condense a known QP, keeping only the fixed entries; its parts as tensors."""
    reduced = programs_of(known).prepared.reduced(known.fixed.shape[-1])
    return Reduced._make(map(to_tensor, reduced))


def soft_qps(known: KnownQP) -> tuple[SoftQPs, BackendSolution]:
    """Make a backend's input in tensors, and its exact solution."""
    reduced, programs = reduced_of(known), programs_of(known)
    fixed = to_tensor(programs.fixed)
    free = torch.cat((fixed, fixed.new_zeros(len(programs), reduced.H.shape[-1])), dim=-1)
    T = to_tensor(programs.prepared.condensed(programs.n_f).T)
    start = multiply(T, to_tensor(programs.group), free) + reduced.z_0
    v = known.z.reshape(len(programs), -1) - start
    v = times(torch.linalg.pinv(T[:, :, -reduced.H.shape[-1] :]), v)
    lam = known.lam.reshape(len(programs), -1)[:, reduced.rows]
    steps = torch.zeros(len(programs), dtype=torch.int64)
    return SoftQPs._make(map(to_tensor, programs.reduced_qps())), BackendSolution(v, lam, steps)


def solution_of(known: KnownQP) -> dict[str, Tensor]:
    names = ("value", "z", "sigma", "chi", "upsilon", "eta", "xi")
    return {name: getattr(known, name) for name in names}


def drawn_mpc(
    n_x: int, n_u: int, horizon: int, n_d: int = 0, *, seed: int = 0, **options: Any
) -> QPMPC:
    """Make a QPMPC of these sizes whose model and weights of states are drawn."""
    kind: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}
    drawing = {"generator": torch.Generator().manual_seed(seed), **kind}
    noise, B = (torch.randn(n_x, n, **drawing) for n in (n_x, n_u))
    weights = 0.5 + 4.5 * torch.rand(n_x, **drawing)
    drawn = {
        "A": torch.eye(n_x, **kind) + 0.1 * noise,
        "B": 0.1 * B,
        "stage_weight": torch.cat((weights, torch.zeros(n_u, **kind))),
        "terminal_weight": [1.0] * n_x,
    }
    return QPMPC.of(n_x, n_u, horizon, n_d, **(drawn | options))


def random_mpc(seed: int = 0, *, free: float = 0.1, horizon: int = 3, **options: Any) -> QPMPC:
    """Make a bounded QPMPC of two states and one action; shift theta by up to ``free``."""
    settings: dict[str, Any] = {
        "state_bounds": ([-1.0, -1.0], [1.0, 1.0]),
        "action_bounds": ([-0.5], [0.5]),
        "stage_weight": [1.0, 0.5, 0.1],
        "terminal_weight": [1.0, 1.0],
        "solver": "daqp",
    }
    mpc = drawn_mpc(2, 1, horizon, seed=seed, **(settings | options))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in mpc.parameters():
            shift = 2 * torch.rand(parameter.shape, generator=generator, dtype=torch.float64) - 1
            parameter += free * shift
    mpc.project_()
    return mpc


def random_states(count: int, n: int = 2, *, size: float = 1.5, seed: int = 0) -> Tensor:
    """Draw states or actions within ``size``, some of them beyond `random_mpc`'s bounds."""
    generator = torch.Generator().manual_seed(seed)
    return size * (2 * torch.rand(count, n, generator=generator, dtype=torch.float64) - 1)


def step(mpc: QPMPC, rate: float = 1e-3) -> None:
    optimizer = torch.optim.Adam(mpc.parameters(), lr=rate)
    mpc(random_states(4)).sum().backward()
    optimizer.step()
    mpc.project_()
    optimizer.zero_grad()


def one_sided(seed: int) -> KnownQP:
    """Make QPs whose soft rows have an upper bound only."""
    known = known_qp(seed, batch=(6,), soft=("above", "at_upper", "inside") * 2)
    lb = known.qp.lb.masked_fill(known.qp.w.isfinite(), -torch.inf)
    return replace(known, qp=replace(known.qp, lb=lb))
