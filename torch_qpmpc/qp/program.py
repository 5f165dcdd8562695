"""The quadratic program of the paper (eq:qp2, eq:qp3), its solution, and its symbols.

    min over z, sigma:   1/2 z'Hz + q'z + c + w'sigma                                 (eq:qp2c0)
    subject to           C z = b                              chi                     (eq:qp2c1)
                         lb - sigma <= G z <= ub + sigma      upsilon, eta >= 0       (eq:qp2c2)
                         sigma >= 0                           mu >= 0                 (eq:qp2c3)
                         x_0 = s                              xi                      (eq:qp2c4)
                         u_0 = a   (action value only)        zeta                    (eq:qp3c2)

The inequality terms of the Lagrangian (eq:lag) are used with the sign that non-negative
multipliers need, upsilon'(lb - sigma - Gz) + eta'(Gz - ub - sigma) - mu'sigma; the printed ones
have it reversed. A row with w_i = inf is hard: its sigma_i is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass, fields
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.errors import QPError
from torch_qpmpc.qp.batching import broadcast
from torch_qpmpc.qp.precision import full_precision
from torch_qpmpc.qp.tracing import has_values

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
#: How many trailing dimensions of each are no batch.
NDIMS = tuple(len(event) for event in EVENT_SHAPES.values())


class Status(IntEnum):
    """Outcome of one QP of a batch; everything but ``SOLVED`` carries no solution."""

    SOLVED = 0
    INFEASIBLE = 1
    UNBOUNDED = 2
    NOT_CONVERGED = 3
    INVALID_DATA = 4

    @property
    def explanation(self) -> str:
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Status.SOLVED: "solved to the certificate's tolerance",
    Status.INFEASIBLE: "no z satisfies C z = b and the hard rows (w = inf); soften rows with a "
    "finite w, or check b, lb and ub",
    Status.UNBOUNDED: "the cost decreases without bound; add curvature to H or bounds to G",
    Status.NOT_CONVERGED: "no solver reached the certificate's tolerance, and nothing proves that "
    "there is no solution; the QP may be ill-conditioned, as predictions of an unstable model are "
    "over a long horizon: shorten it, give the model a stabilising feedback u = K x + v, or "
    "rescale the QP",
    Status.INVALID_DATA: "NaN or inf in the data, lb > ub, or an H that is not positive "
    "semidefinite; look at the parameters and the state",
}


class Sizes(NamedTuple):
    """What follows from the shapes of a QP's tensors: the batch's, and the most entries of one."""

    batch_shape: torch.Size
    largest: int

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> Sizes:
        """Of H, q, c, C, b, G, lb, ub, w; `RuntimeError` where batches do not broadcast."""
        batches = (x.shape[: x.ndim - n] for x, n in zip(tensors, NDIMS, strict=True))
        return cls(broadcast(*batches), max(x.numel() for x in tensors))


#: Of shapes, dtypes and devices that were found to fit: training asks for the same all the time.
_accepted: dict[Any, Sizes] = {}
#: How many of them are remembered.
_MOST = 16


def _kind(tensors: Sequence[Tensor]) -> tuple | None:
    """What they are remembered by; None of what is no tensor, or has a symbolic shape."""
    if torch.compiler.is_compiling():
        return None
    try:
        kind = tuple([(x.shape, x.dtype, x.device) for x in tensors])
        hash(kind)
    except (AttributeError, TypeError):
        return None
    return kind


@dataclass(frozen=True, repr=False)
class QuadraticProgram:
    """A validated batch of parametric QPs (eq:qp2).

    Every tensor may have leading batch dimensions; they broadcast against each other. A tensor
    without them is shared by the whole batch, and its gradient is the batch's sum.

    Args:
        H: cost matrix, ``(*batch, n_z, n_z)``, symmetric positive semidefinite.
        q: linear cost, ``(*batch, n_z)``.
        c: constant cost, ``(*batch,)``.
        C: equality matrix, ``(*batch, n_c, n_z)``.
        b: equality right-hand side, ``(*batch, n_c)``.
        G: inequality matrix, ``(*batch, n_g, n_z)``.
        lb: lower bounds, ``(*batch, n_g)``; ``-inf`` where there is none.
        ub: upper bounds, ``(*batch, n_g)``; ``inf`` where there is none.
        w: weights of the l1 relaxation, ``(*batch, n_g)``, non-negative; ``inf`` is a hard row.
        check_values: also check the values (finite, H symmetric and positive semidefinite,
            lb <= ub, w >= 0), not only the shapes. `QPMPC` passes ``False``: its parametrisation
            guarantees them, and whatever training makes of theta is caught by the solve.

    Raises:
        QPError: a shape, a dtype or a value that is none; the message names the argument.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> one = torch.ones(1)
        >>> qp = qm.QuadraticProgram(
        ...     H=torch.eye(1),
        ...     q=-2 * one,
        ...     c=torch.zeros(()),
        ...     C=torch.zeros(0, 1),
        ...     b=torch.zeros(0),
        ...     G=torch.eye(1),
        ...     lb=-one,
        ...     ub=one,
        ...     w=torch.inf * one,
        ... )
        >>> qm.solve_qp(qp).z
        tensor([1.])
    """

    H: Tensor
    q: Tensor
    c: Tensor
    C: Tensor
    b: Tensor
    G: Tensor
    lb: Tensor
    ub: Tensor
    w: Tensor
    check_values: InitVar[bool] = True

    def __post_init__(self, check_values: bool) -> None:
        self._check_shapes()
        if check_values:
            self._check_values()

    @property
    def n_z(self) -> int:
        return self.H.shape[-1]

    @property
    def batch_shape(self) -> torch.Size:
        return self.sizes.batch_shape

    @property
    def sizes(self) -> Sizes:
        """Worked out once for all QPs of the same shapes."""
        tensors = self.tensors()
        return _accepted.get(_kind(tensors)) or Sizes.of(tensors)

    def __repr__(self) -> str:
        """Sizes, dtype and device, without the tensors' entries."""
        sizes = f"n_z={self.n_z}, n_c={self.b.shape[-1]}, n_g={self.lb.shape[-1]}"
        kind = f"dtype={self.H.dtype}, device={str(self.H.device)!r}"
        return f"QuadraticProgram(batch_shape={tuple(self.batch_shape)}, {sizes}, {kind})"

    def tensors(self) -> tuple[Tensor, ...]:
        """H, q, c, C, b, G, lb, ub, w."""
        return (self.H, self.q, self.c, self.C, self.b, self.G, self.lb, self.ub, self.w)

    def _check_shapes(self) -> None:
        kind = _kind(self.tensors())
        if kind is not None and kind in _accepted:
            return
        self._check_each_shape()
        if kind is not None:
            if len(_accepted) >= _MOST:
                _accepted.clear()
            _accepted[kind] = self.sizes

    def _check_each_shape(self) -> None:
        for field in fields(self):
            tensor = getattr(self, field.name)
            if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
                got = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
                raise QPError.expected(
                    field.name,
                    got,
                    "a floating-point torch.Tensor",
                    "Convert it with torch.as_tensor(..., dtype=torch.float64).",
                )
            if tensor.dtype not in (torch.float32, torch.float64):
                remedy = "Half precision has no factorisations: use torch.float64."
                got = tensor.dtype
                raise QPError.expected(field.name, got, "torch.float32 or torch.float64", remedy)
            if tensor.device != self.H.device:
                got, remedy = f"a tensor on {tensor.device}", "Move all nine to one device."
                raise QPError.expected(field.name, got, f"one on H's {self.H.device}", remedy)
            if tensor.dtype != self.H.dtype:
                raise QPError.expected(
                    field.name,
                    tensor.dtype,
                    f"H's dtype {self.H.dtype}",
                    "Give all nine tensors one dtype.",
                )
        sizes: dict[str, tuple[str, int]] = {}
        for name, event in EVENT_SHAPES.items():
            tensor = getattr(self, name)
            want = f"(*batch, {', '.join(event)})" if event else "(*batch,)"
            if tensor.ndim < len(event):
                raise QPError.expected(name, f"shape {tuple(tensor.shape)}", f"shape {want}")
            for symbol, size in zip(event, tensor.shape[tensor.ndim - len(event) :], strict=True):
                source, known = sizes.setdefault(symbol, (name, size))
                if size != known:
                    raise QPError.expected(
                        name,
                        f"shape {tuple(tensor.shape)}",
                        f"shape {want} with {symbol} = {known} as in {source}",
                    )
        try:
            _ = self.sizes
        except RuntimeError as error:
            shapes = {name: tuple(getattr(self, name).shape) for name in EVENT_SHAPES}
            raise QPError.expected(
                "batch", f"shapes {shapes}", "leading dimensions that broadcast"
            ) from error

    def _check_values(self) -> None:
        for name in ("H", "q", "c", "C", "b", "G"):
            if not getattr(self, name).isfinite().all():
                raise QPError.expected(name, "NaN or inf", "finite entries")
        for name, forbidden in (("lb", torch.inf), ("ub", -torch.inf), ("w", -torch.inf)):
            tensor = getattr(self, name)
            if (tensor.isnan() | (tensor == forbidden)).any():
                raise QPError.expected(name, f"NaN or {forbidden}", "no NaN, and no such infinity")
        if crossed(self.lb, self.ub).any():
            excess = (self.lb - self.ub).max().item()
            raise QPError.expected("lb", f"lb > ub by up to {excess:.3g}", "lb <= ub in every row")
        if (self.w < 0).any():
            raise QPError.expected(
                "w",
                f"{self.w.min().item():.3g}",
                "non-negative slack weights",
                "Use inf for a hard row.",
            )
        asymmetry = (
            (self.H - self.H.mT).abs().amax(dim=(-2, -1)) if self.n_z else self.H.new_zeros(1)
        )
        scale = self.H.abs().amax(dim=(-2, -1)) if self.n_z else asymmetry
        tolerance = 1e-5 if self.H.dtype == torch.float32 else 1e-9
        if (asymmetry > tolerance * scale).any():
            raise QPError.expected(
                "H",
                f"asymmetry {asymmetry.max():.3g}",
                "a symmetric matrix",
                "Pass (H + H.mT) / 2.",
            )
        if (
            self.n_z
            and (torch.linalg.eigvalsh(self.H)[..., 0] < -tolerance * (scale + 1e-300)).any()
        ):
            lowest = torch.linalg.eigvalsh(self.H)[..., 0].min().item()
            raise QPError.expected(
                "H",
                f"smallest eigenvalue {lowest:.3g}",
                "a positive semidefinite matrix",
                "Parameterise H by its Cholesky factor (torch_qpmpc.mpc.parametrizations).",
            )


#: Units of rounding by which bounds that should be equal may cross.
CROSSING = 4.0


def crossed(lb: Tensor, ub: Tensor) -> Tensor:
    """Where lb > ub, and not by rounding alone."""
    size, gap = lb.abs().maximum(ub.abs()), lb - ub
    return (gap > CROSSING * torch.finfo(lb.dtype).eps * size) | (gap == torch.inf)


#: A multiplier below this fraction of the largest is zero; one as near to w is saturated.
ACTIVE_FRACTION = 1e-8
#: In the place of a row's state: nothing is known, as before an element is solved.
UNKNOWN = 127


def active_rows(lam: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Which rows are held at a bound, and which are saturated at |lam| = w, ``(*batch, n_g)``."""
    size = lam.abs()
    saturated = w.isfinite() & (size >= (1 - ACTIVE_FRACTION) * w)
    largest = size.amax(-1, keepdim=True) if size.shape[-1] else size
    return (size > ACTIVE_FRACTION * (1 + largest)) & ~saturated, saturated


def row_states(p, lower, upper, w) -> tuple:
    """Each row's nearest bound, whether it is active there, and lam if not; arrays or tensors.

    The excess of ``p = y + lam`` over the bounds would be the multiplier; |lam| <= w caps it.
    """
    bound = p.clip(lower, upper)
    excess = p - bound
    held = excess.clip(-w, w)
    active = (held == excess) & ((excess != 0) | (lower == upper))
    return bound, active, held


@dataclass(frozen=True, repr=False)
class QPSolution:
    """Primal-dual solution of a batch of QPs.

    All but ``active`` and the last three is differentiable in the tensors of the QP and in the
    fixed entries. An element that is not solved (``status != 0``; only with ``on_failure`` "warn"
    or "mask") has ``value = inf``, the fixed entries in ``z``, zeros elsewhere, and no gradient.

    Attributes:
        qp: the problems that this solves.
        value: optimal cost, ``(*batch,)``.
        z: minimiser, ``(*batch, n_z)``.
        chi: multipliers of C z = b, ``(*batch, n_c)``.
        lam: signed multipliers eta - upsilon of the rows, ``(*batch, n_g)``.
        xi: multipliers of the fixed entries, ``(*batch, n_f)``: the paper's xi, then zeta.
        status: `Status` as integers, ``(*batch,)``.
        residual: relative KKT residual found by the certificate, ``(*batch,)``.
        iterations: the solver's iterations, ``(*batch,)``.
    """

    qp: QuadraticProgram
    value: Tensor
    z: Tensor
    chi: Tensor
    lam: Tensor
    xi: Tensor
    status: Tensor
    residual: Tensor
    iterations: Tensor

    def __repr__(self) -> str:
        """Sizes, how many elements have each status, and the range of the values."""
        lines = [
            f"batch_shape={tuple(self.status.shape)}, n_f={self.xi.shape[-1]}",
            f"qp={self.qp!r}",
        ]
        if has_values(self.status):
            solved = self.solved
            outcome = [f"solved {int(solved.sum())} of {solved.numel()}"]
            for status in list(Status)[1:]:
                if count := int((self.status == status).sum()):
                    outcome.append(f"{count} {status.name}")
            lines.append(", ".join(outcome))
            if solved.any():
                value, residual = self.value.detach()[solved], self.residual[solved].max()
                of_values = f"value from {value.min():.4g} to {value.max():.4g}"
                lines.append(f"{of_values}, residual up to {residual:.2g}")
        body = ",\n".join(f"    {line}" for line in lines)
        return f"QPSolution(\n{body},\n)"

    @property
    def solved(self) -> Tensor:
        """Which elements are certified solutions, ``(*batch,)``."""
        return self.status == Status.SOLVED

    @property
    def sigma(self) -> Tensor:
        """Slacks, ``(*batch, n_g)``, zero on hard rows."""
        qp = self.qp
        return self._where_solved(slacks(self.z, qp.G, qp.lb, qp.ub, qp.w))

    @property
    def upsilon(self) -> Tensor:
        """Multipliers of the lower bounds, ``(*batch, n_g)``, non-negative."""
        return (-self.lam).clamp(min=0)

    @property
    def eta(self) -> Tensor:
        """Multipliers of the upper bounds, ``(*batch, n_g)``, non-negative."""
        return self.lam.clamp(min=0)

    @property
    def mu(self) -> Tensor:
        """Multipliers of sigma >= 0, ``w - upsilon - eta``, ``(*batch, n_g)``; inf on hard rows."""
        return self._where_solved(self.qp.w - self.upsilon - self.eta)

    @property
    def active(self) -> Tensor:
        """The active set as int8 ``(*batch, n_g)``, which is a warm start for a nearly equal QP.

        0 is a row without multiplier, 1 one that is held at ub and -1 one at lb; 2 and -2 are rows
        saturated there, at eta = w or upsilon = w. All rows of an unsolved element are `UNKNOWN`.
        """
        z, lam, qp = self.z.detach(), self.lam.detach(), self.qp
        y = _rows(z, qp.G)
        _, held, fixed = row_states(y + lam, qp.lb, qp.ub, qp.w)
        active = torch.where(held, lam.sign(), 2 * fixed.sign()).detach().to(torch.int8)
        return active.masked_fill_(~self.solved.unsqueeze(-1), UNKNOWN)

    def _where_solved(self, rows: Tensor) -> Tensor:
        return torch.where(self.solved.unsqueeze(-1), rows, 0)


def slacks(z: Tensor, G: Tensor, lb: Tensor, ub: Tensor, w: Tensor) -> Tensor:
    """sigma of z: how far soft rows are outside their bounds, ``(*batch, n_g)``."""
    y = _rows(z, G)
    return torch.where(w.isinf(), 0, torch.maximum(lb - y, y - ub).clamp(min=0))


def _rows(z: Tensor, G: Tensor) -> Tensor:
    with full_precision(z):
        return z @ G.mT if G.ndim == 2 else (z.unsqueeze(-2) @ G.mT).squeeze(-2)
