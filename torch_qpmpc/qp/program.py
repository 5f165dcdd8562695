"""The paper's quadratic program (eq:qp2, eq:qp3), its symbols, and the status of its solution.

    min over z, sigma:   1/2 z'Hz + q'z + c + w'sigma                                 (eq:qp2c0)
    subject to           C z = b                              chi                     (eq:qp2c1)
                         lb - sigma <= G z <= ub + sigma      upsilon, eta >= 0       (eq:qp2c2)
                         sigma >= 0                           mu >= 0                 (eq:qp2c3)
                         x_0 = s                              xi                      (eq:qp2c4)
                         u_0 = a   (action value only)        zeta                    (eq:qp3c2)

The inequality terms of the Lagrangian (eq:lag) have the sign that non-negative multipliers need,
upsilon'(lb - sigma - Gz) + eta'(Gz - ub - sigma) - mu'sigma; the paper prints the opposite sign.
A row with w_i = inf is hard: its sigma_i is zero.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import InitVar, dataclass
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor

from torch_qpmpc.checks import check_whole
from torch_qpmpc.errors import QPError

#: Trailing (event) dimensions of each tensor of a QP, in the order of the constructor.
EVENT_SHAPES: dict[str, tuple[str, ...]] = {
    "H": ("n_z", "n_z"),
    "q": ("n_z",),
    "c": (),
    "C": ("n_c", "n_z"),
    "b": ("n_c",),
    "G": ("n_g", "n_z"),
    "lb": ("n_g",),
    "ub": ("n_g",),
    "w": ("n_g",),
}
#: The dtypes for which torch factorises matrices.
DTYPES = (torch.float32, torch.float64)
#: The number of event dimensions of each tensor.
NDIMS = tuple(len(event) for event in EVENT_SHAPES.values())


class Status(IntEnum):
    """Outcome of one QP of a batch; only ``SOLVED`` and ``NODE_LIMIT`` have a solution.

    ``INFEASIBLE`` and ``UNBOUNDED`` are proved, ``NOT_CONVERGED`` is neither proved nor solved, and
    ``INVALID_DATA`` has NaN, crossing bounds or a cost that is not convex. ``NODE_LIMIT`` is
    the best plan on levels that a search of `Bounds.max_nodes` found.

    Example:
        >>> import torch_qpmpc as qm
        >>> qm.Status.UNBOUNDED.explanation
        'the cost decreases without bound; add curvature to H or bounds to G'
    """

    SOLVED = 0
    INFEASIBLE = 1
    UNBOUNDED = 2
    NOT_CONVERGED = 3
    INVALID_DATA = 4
    NODE_LIMIT = 5

    @property
    def explanation(self) -> str:
        """Cause of the status, with a remedy."""
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Status.SOLVED: "solved to the certificate's tolerance",
    Status.INFEASIBLE: "no z satisfies C z = b and the hard rows (w = inf); soften rows with a "
    "finite w, or check s, a, b, lb, ub and levels",
    Status.UNBOUNDED: "the cost decreases without bound; add curvature to H or bounds to G",
    Status.NOT_CONVERGED: "no solver reached the certificate's tolerance, and the QP is neither "
    "provably infeasible nor unbounded; it may be ill-conditioned, like the predictions of an "
    "unstable model over a long horizon: shorten the horizon, give the model a stabilising "
    "feedback u = K x + v, or rescale the QP; or a search for levels needs more max_nodes",
    Status.NODE_LIMIT: "the plan keeps levels and minimum times, and a better one may exist: the "
    "search ended at its number of nodes; pass a shorter integer_horizon, or more max_nodes",
    Status.INVALID_DATA: "NaN or inf in the data, lb > ub, or an H that is not positive "
    "semidefinite; check the parameters and the state",
}


def broadcast(*shapes: Sequence[int]) -> torch.Size:
    """Return `torch.broadcast_shapes`, faster for shapes that are equal or empty."""
    common: Sequence[int] = ()
    for shape in filter(len, shapes):
        if len(common) and tuple(shape) != tuple(common):
            return torch.broadcast_shapes(*shapes)
        common = shape
    return torch.Size(common)


def batch_shape(tensors: Sequence[Tensor]) -> torch.Size:
    """Return the batch shape of H, q, .., w; raise `RuntimeError` if they do not broadcast."""
    return broadcast(*(x.shape[: x.ndim - n] for x, n in zip(tensors, NDIMS, strict=True)))


ABSENT: Any = None  # the default of a part that a QP need not have


@dataclass(frozen=True, repr=False)
class QuadraticProgram:
    """A validated batch of parametric QPs (eq:qp2).

    Every tensor may have leading batch dimensions; they broadcast against each other. A tensor
    without them is shared by the whole batch, and its gradient is summed over it. None stands for
    what a QP has not: no constant, equations, rows or bounds.

    Args:
        H: cost matrix, ``(*batch, n_z, n_z)``, symmetric positive semidefinite.
        q: linear cost, ``(*batch, n_z)``.
        c: constant cost, ``(*batch,)``.
        C: equality matrix, ``(*batch, n_c, n_z)``.
        b: equality right-hand side, ``(*batch, n_c)``.
        G: inequality matrix, ``(*batch, n_g, n_z)``; the identity if only bounds are given.
        lb: lower bounds, ``(*batch, n_g)``; ``-inf``, or -1e20 and less, where there is none.
        ub: upper bounds, ``(*batch, n_g)``; ``inf``, or 1e20 and more, where there is none.
            Smaller bounds count, and cost no accuracy where they are far from the solution.
        w: weights of the l1 relaxation, ``(*batch, n_g)``, non-negative; ``inf``, as by
            default, is a hard row.
        check_values: also check the values (finite, H symmetric and positive semidefinite,
            lb <= ub, w >= 0). `QPMPC` passes ``False``: its parametrisations guarantee them, and
            the solve detects values that training has made invalid.
        n_known: the number of leading entries of z that each solve fixes: only the block of H
            after them need be positive semidefinite.

    Raises:
        QPError: a tensor's type, shape, dtype, device or values are invalid.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> qp = qm.QuadraticProgram(torch.eye(2), torch.tensor([-2.0, 0.5]), ub=torch.ones(2))
        >>> qm.solve_qp(qp).z
        tensor([ 1.0000, -0.5000])
    """

    H: Tensor
    q: Tensor
    c: Tensor = ABSENT
    C: Tensor = ABSENT
    b: Tensor = ABSENT
    G: Tensor = ABSENT
    lb: Tensor = ABSENT
    ub: Tensor = ABSENT
    w: Tensor = ABSENT
    check_values: InitVar[bool] = True
    n_known: InitVar[int] = dataclasses.field(default=0, kw_only=True)

    def __post_init__(self, check_values: bool, n_known: int) -> None:
        self._fill()
        self._check_events()
        try:
            _ = self.batch_shape
        except RuntimeError as error:
            shapes = {name: tuple(getattr(self, name).shape) for name in EVENT_SHAPES}
            want = "leading dimensions that broadcast"
            raise QPError.expected("batch", f"shapes {shapes}", want) from error
        if n_known != 0:
            check_whole("n_known", n_known, 0)
        if check_values:
            self._check_values(n_known)

    @property
    def n_z(self) -> int:
        """Number of variables."""
        return self.H.shape[-1]

    @property
    def batch_shape(self) -> torch.Size:
        """Common batch shape of all tensors."""
        return batch_shape(self.tensors())

    def __repr__(self) -> str:
        """Show sizes, dtype and device, without the tensors' entries."""
        sizes = f"n_z={self.n_z}, n_c={self.b.shape[-1]}, n_g={self.lb.shape[-1]}"
        kind = f"dtype={self.H.dtype}, device={str(self.H.device)!r}"
        return f"QuadraticProgram(batch_shape={tuple(self.batch_shape)}, {sizes}, {kind})"

    def tensors(self) -> tuple[Tensor, ...]:
        """Return H, q, c, C, b, G, lb, ub, w."""
        return (self.H, self.q, self.c, self.C, self.b, self.G, self.lb, self.ub, self.w)

    def _fill(self) -> None:  # parts that are absent
        H, G, given = self.H, self.G, self.tensors()
        if all(x is not None for x in given) or not torch.is_tensor(H) or not H.is_floating_point():
            return
        one = H.new_ones(H.shape[-1] if H.ndim else 0)
        G = one.diag()[: 0 if self.lb is self.ub is None else None] if G is None else G
        n_g = G.shape[-2] if isinstance(G, Tensor) and G.ndim > 1 else 0
        row = one.new_full((n_g,), torch.inf)
        none = (H, None, one.new_zeros(()), one.diag()[:0], one[:0], G, -row, row, row)
        for name, x, absent in zip(EVENT_SHAPES, given, none, strict=True):
            if x is None:
                object.__setattr__(self, name, absent)

    def _check_events(self) -> None:
        for name, x in zip(EVENT_SHAPES, self.tensors(), strict=True):
            if not isinstance(x, Tensor) or not x.is_floating_point():
                got = x.dtype if isinstance(x, Tensor) else type(x).__name__
                expected = "a floating-point torch.Tensor"
                remedy = "Convert it with torch.as_tensor(..., dtype=torch.float64)."
            elif x.dtype not in DTYPES:
                got, expected = x.dtype, "torch.float32 or torch.float64"
                remedy = "Half precision has no matrix factorisations: use torch.float64."
            elif x.device != self.H.device:
                got, expected = f"a tensor on {x.device}", f"one on H's device, {self.H.device}"
                remedy = "Move all nine to one device."
            elif x.dtype != self.H.dtype:
                got, expected = x.dtype, f"H's dtype {self.H.dtype}"
                remedy = "Give all nine tensors one dtype."
            else:
                continue
            raise QPError.expected(name, got, expected, remedy)
        sizes: dict[str, tuple[str, int]] = {}
        for (name, event), x in zip(EVENT_SHAPES.items(), self.tensors(), strict=True):
            if x.ndim < len(event):
                raise _misshapen(name, x)
            for symbol, size in zip(event, x.shape[x.ndim - len(event) :], strict=True):
                source, known = sizes.setdefault(symbol, (name, size))
                if size != known:
                    raise _misshapen(name, x, f" with {symbol} = {known} as in {source}")

    def _check_values(self, n_known: int) -> None:
        H, lb, ub, w = self.H, self.lb, self.ub, self.w
        for name in ("H", "q", "c", "C", "b", "G"):
            x = getattr(self, name)
            if not (x.sum().isfinite() or x.isfinite().all()):  # a sum takes a sixth of the time
                raise QPError.expected(name, "NaN or inf", "finite entries")
        infinities = {"lb": torch.inf, "ub": -torch.inf, "w": -torch.inf}
        for (name, forbidden), x in zip(infinities.items(), (lb, ub, w), strict=True):
            if (x.isnan() | (x == forbidden)).any():
                raise QPError.expected(name, f"NaN or {forbidden}", f"numbers or {-forbidden}")
        if crossed(lb, ub).any():
            got = f"lb > ub by up to {(lb - ub).max().item():.3g}"
            raise QPError.expected("lb", got, "lb <= ub in every row")
        if (w < 0).any():
            got, expected = f"{w.min().item():.3g}", "non-negative slack weights"
            raise QPError.expected("w", got, expected, "Use inf for a hard row.")
        if not self.n_z:
            return
        asymmetry, scale = (x.abs().amax(dim=(-2, -1)) for x in (H - H.mT, H))
        tolerance = 1e-5 if H.dtype == torch.float32 else 1e-9
        if (asymmetry > tolerance * scale).any():
            got, remedy = f"asymmetry {asymmetry.max():.3g}", "Pass (H + H.mT) / 2."
            raise QPError.expected("H", got, "a symmetric matrix", remedy)
        if n_known >= self.n_z:
            return
        lowest = torch.linalg.eigvalsh(H[..., n_known:, n_known:])[..., 0]
        if (lowest < -tolerance * (scale + 1e-300)).any():
            raise QPError.expected(
                "H",
                f"smallest eigenvalue {lowest.min().item():.3g}",
                "a positive semidefinite matrix",
                "Parameterise H by its Cholesky factor (torch_qpmpc.mpc.parametrizations), or pass "
                "n_known if the first entries of z are known.",
            )


#: The code of every row in the active set of an unsolved QP.
UNKNOWN = 127

#: An upper bound of this size, or a lower one of minus this, counts as infinite.
INFINITE = 1e20
#: The certificate rejects a solution with a larger relative residual or error of its value.
TOLERANCE = 1e-6
#: Bounds that cross by at most this many machine epsilons are equal.
CROSSING = 4.0


def _misshapen(name: str, x: Tensor, more: str = "") -> QPError:
    want = f"shape (*batch, {', '.join(EVENT_SHAPES[name])}){more}"
    return QPError.expected(name, f"shape {tuple(x.shape)}", want)


def crossed(lb: Tensor, ub: Tensor) -> Tensor:
    """Return the mask of rows where lb exceeds ub by more than rounding, ``(*batch, n_g)``."""
    size, gap = lb.abs().maximum(ub.abs()), lb - ub
    return (gap > CROSSING * torch.finfo(lb.dtype).eps * size) | (gap == torch.inf)
