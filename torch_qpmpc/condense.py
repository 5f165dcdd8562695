"""Condensing: eliminate C z = b once per theta, so that a sample only moves vectors.

With y = (z[:keep], v), the kept leading entries and the independent ones among the rest, every
solution of C z = b is ``z = Y b + T y``. All samples of a batch, and V, Q and the policy, share T,
Y, T'HT and GT; fixing the first n_f <= keep entries then only changes a linear term and offsets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torch_qpmpc.programs import ContentMemo, FlatPrograms, SoftQPs

#: A pivot below this fraction of its row's norm means that the rows of C depend on each other.
RANK_TOLERANCE = 1e-10
#: A coefficient below this fraction of its row's absolute sum is rounding.
ENTERS = 1e-12
#: A row that no free variable enters is violated from here on.
VIOLATED = 1e-9
#: H is indefinite if an eigenvalue is below minus this fraction of the largest.
CONVEX = 1e-9


@dataclass(frozen=True, eq=False)
class Condensed:
    """The part of condensing that depends on (H, C, G) alone.

    T ``(M, n_z, n_y)``, Y_neg = -Y ``(M, n_z, n_c)``, H = T'HT ``(M, n_y, n_y)``, G = GT
    ``(M, n_g, n_y)``, and what b contributes: H_b = T'HY ``(M, n_y, n_c)``, G_b = GY
    ``(M, n_g, n_c)``. ``surely_convex`` says that all of H is, so that no part of it need be looked
    at. Where the columns after ``keep`` do not have full row rank, ``deficient`` says so: then it
    is valid only for QPs that fix exactly ``keep`` entries.
    """

    keep: int
    deficient: bool
    T: Tensor
    Y_neg: Tensor
    H: Tensor
    G: Tensor
    H_b: Tensor
    G_b: Tensor
    surely_convex: bool

    def convex(self, n_f: int) -> Tensor:
        """Where H is positive semidefinite in what is free with n_f entries fixed, ``(M,)``."""
        if self.surely_convex:
            return torch.ones(len(self.H), dtype=torch.bool, device=self.H.device)
        return _convex(self.H[:, n_f:, n_f:])

    def reduced(self, programs: FlatPrograms) -> Reduced:
        """The problem in what is free of ``programs``."""
        key = ("reduced", self.keep, programs.fixed.shape[-1])
        return programs.known(key, lambda: Reduced.of(self, programs))


@dataclass(frozen=True, eq=False)
class Reduced:
    """The condensed problem with the first n_f entries fixed: its data are affine in those.

    Of the rows of G, ``rows`` are its own, and ``others`` those that no free variable enters or
    that have no finite bound. A leading B is 1 where the batch shares it. The sums that make a
    sample's problem, with ``fixed`` ``(B, n_f)`` and its variables v ``(B, d)``:

        g = linear + H_f fixed,  (l, u) = bounds - G_f fixed,  z = origin + T_f fixed + T_v v

    Attributes:
        H, G: ``(M, d, d)`` and ``(M, r, d)``.
        H_f, G_f: ``(M, d, n_f)`` and ``(M, r, n_f)``.
        T_f, T_v, Y_neg: ``(M, n_z, n_f)``, ``(M, n_z, d)`` and ``(M, n_z, n_c)``.
        linear, origin: ``(B, d)`` and ``(B, n_z)``.
        lower, upper, w, minus_w: ``(B, r)``.
        w_others: ``(B, n_g - r)``, zero where inf: violated, a hard one stays so.
        place: where ``(others, rows)`` belong, ``(n_g,)``, or None if they are in order.
        convex: where H is positive semidefinite, ``(M,)``.
    """

    rows: Tensor
    others: Tensor
    H: Tensor
    G: Tensor
    H_f: Tensor
    G_f: Tensor
    T_f: Tensor
    T_v: Tensor
    Y_neg: Tensor
    linear: Tensor
    origin: Tensor
    lower: Tensor
    upper: Tensor
    w: Tensor
    minus_w: Tensor
    w_others: Tensor
    place: Tensor | None
    convex: Tensor

    @classmethod
    def of(cls, condensed: Condensed, p: FlatPrograms) -> Reduced:
        n_f = p.fixed.shape[-1]
        # Rounding in the elimination leaves traces of variables that a row does not contain.
        size = condensed.G.abs()
        entered = size[:, :, n_f:] > ENTERS * size.sum(dim=2, keepdim=True)
        bounded = (p.lb > -torch.inf) | (p.ub < torch.inf)
        own = bounded.any(dim=0) & entered.any(dim=2).any(dim=0)
        rows, others = own.nonzero().squeeze(-1), (~own).nonzero().squeeze(-1)
        in_order = not len(others) or not len(rows) or bool(others[-1] < rows[0])
        G, w, w_others = condensed.G[:, rows], p.w[:, rows], p.w[:, others]
        H, T_v = condensed.H[:, n_f:], condensed.T[:, :, n_f:]
        shift = p.multiply(condensed.G_b[:, rows], p.b)
        return cls(
            rows,
            others,
            H=H[:, :, n_f:].contiguous(),
            G=G[:, :, n_f:].contiguous(),
            H_f=H[:, :, :n_f],
            G_f=G[:, :, :n_f],
            T_f=condensed.T[:, :, :n_f],
            T_v=T_v,
            Y_neg=condensed.Y_neg,
            linear=p.multiply(T_v.mT, p.q) + p.multiply(condensed.H_b[:, n_f:], p.b),
            origin=-p.multiply(condensed.Y_neg, p.b),
            lower=p.lb[:, rows] - shift,
            upper=p.ub[:, rows] - shift,
            w=w,
            minus_w=-w,
            w_others=w_others.masked_fill(w_others.isinf(), 0),
            place=None if in_order else torch.cat((others, rows)).argsort(),
            convex=condensed.convex(n_f),
        )

    def soft_qps(self, programs: FlatPrograms) -> SoftQPs:
        """What a backend solves; its rows are ``rows``."""
        p = programs
        offset = p.multiply(self.G_f, p.fixed)
        return SoftQPs(
            H=self.H,
            G=self.G,
            group=p.group,
            g=p.multiply(self.H_f, p.fixed) + self.linear,
            l=self.lower - offset,
            u=self.upper - offset,
            w=self.w.expand(len(p), -1),
        )

    def all_rows(self, lam: Tensor, beyond: Tensor) -> Tensor:
        """Multipliers ``(B, n_g)`` from those of ``rows``, ``(B, r)``.

        A row that no free variable enters has w where it is violated: ``beyond`` ``(B, n_g)`` is
        how far it is above (or below, negative) its bounds.
        """
        lam = lam.clamp(self.minus_w, self.w)
        if not len(self.others):
            return lam
        y = beyond[:, : len(self.others)] if self.place is None else beyond[:, self.others]
        forced = (y.abs() > VIOLATED) * y.sign() * self.w_others
        lam = torch.cat((forced, lam), dim=-1)
        return lam if self.place is None else lam[:, self.place]

    def particular(self, programs: FlatPrograms) -> Tensor:
        """z at v = 0: what b and the fixed entries contribute, ``(B, n_z)``."""
        return self.origin + programs.multiply(self.T_f, programs.fixed)

    def expand(self, programs: FlatPrograms, v: Tensor) -> Tensor:
        """The full z ``(B, n_z)`` from the free variables v ``(B, d)``."""
        return self.particular(programs) + programs.multiply(self.T_v, v)


def _convex(H: Tensor) -> Tensor:
    """Where H is positive semidefinite but for rounding, ``(M,)``."""
    eigenvalues = torch.linalg.eigvalsh(H) if H.shape[-1] else H.new_zeros(len(H), 1)
    return eigenvalues[:, 0] >= -CONVEX * (1 + eigenvalues.abs().amax(-1))


def _surely_convex(H: Tensor) -> bool:
    """Whether Cholesky factors prove it of all, in a fraction of the time."""
    if not H.shape[-1]:
        return True
    diagonal = H.diagonal(dim1=-2, dim2=-1)
    shift = CONVEX * (1 + diagonal.amax(-1, keepdim=True))
    return not torch.linalg.cholesky_ex(H + torch.diag_embed(shift.expand_as(diagonal)))[1].any()


def condense(H: Tensor, C: Tensor, G: Tensor, keep: int) -> Condensed:
    """Condense M matrix triples, keeping the first ``keep`` entries of z as they are.

    The last few results are remembered by the content of the matrices.
    """
    return _memo.get((C, H, G), keep, lambda C, H, G: _condense(H, C, G, keep))


_memo = ContentMemo()


def _condense(H: Tensor, C: Tensor, G: Tensor, keep: int) -> Condensed:
    eliminated = _eliminate(C, keep)
    T, Y, padding = _null_space(C, keep) if eliminated is None else (*eliminated, None)
    H_T = H @ T
    H_y = T.mT @ H_T
    H_y = (H_y + H_y.mT) / 2
    if padding is not None:
        H_y = H_y + torch.diag_embed(padding)
    deficient, convex = eliminated is None, _surely_convex(H_y)
    return Condensed(keep, deficient, T, -Y, H_y, G @ T, H_T.mT @ Y, G @ Y, convex)


def condensed_for(programs: FlatPrograms, keep: int) -> Condensed:
    """Condensed with ``keep`` entries kept, or just the fixed ones where C does not allow more."""
    n_f = programs.fixed.shape[-1]
    return programs.known(("condensed", keep, n_f), lambda: _condensed_for(programs, keep))


def _condensed_for(programs: FlatPrograms, keep: int) -> Condensed:
    H, C, G = programs.H, programs.C, programs.G
    condensed = condense(H, C, G, keep)
    n_f = programs.fixed.shape[-1]
    return condense(H, C, G, n_f) if condensed.deficient and keep > n_f else condensed


def _eliminate(C: Tensor, keep: int) -> tuple[Tensor, Tensor] | None:
    """T and Y with the dependent columns chosen by LU pivoting; None if rows of C depend."""
    eliminated = [_eliminate_one(one, keep) for one in C.cpu().numpy()]
    if not all(eliminated):
        return None
    M, n_c, n_z = C.shape
    T, Y = (np.array(part) for part in zip(*eliminated, strict=True)) if M else ((), ())
    shapes = (M, n_z, n_z - n_c), (M, n_z, n_c)
    T, Y = (torch.as_tensor(x).reshape(n).to(C) for x, n in zip((T, Y), shapes, strict=True))
    return T, Y


def _eliminate_one(C: np.ndarray, keep: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Row pivoting on the transpose of C picks columns of C that are safe to solve for.

    For a linear MPC scheme they are x_1..x_N, and then T is its prediction form.
    """
    n_c, n_z = C.shape
    rest = C[:, keep:]
    if n_c > rest.shape[1]:
        return None
    order = np.arange(n_z - keep)
    if n_c:
        factors: Any = scipy.linalg.lu(rest.T, p_indices=True, check_finite=False)
        position, _, upper = factors
        norms = np.sqrt((rest * rest).sum(axis=1))
        if (np.abs(upper.diagonal()) <= RANK_TOLERANCE * norms).any():
            return None
        order[position] = order.copy()
    order += keep
    dependent = order[:n_c]
    columns = np.concatenate((np.arange(keep), np.sort(order[n_c:])))
    right = np.concatenate((np.eye(n_c), -C[:, columns]), axis=1)
    solved = np.linalg.solve(C[:, dependent], right)
    Y, T = np.zeros((n_z, n_c)), np.zeros((n_z, n_z - n_c))
    Y[dependent], T[dependent] = solved[:, :n_c], solved[:, n_c:]
    T[columns, np.arange(n_z - n_c)] = 1
    return T, Y


def _null_space(C: Tensor, keep: int) -> tuple[Tensor, Tensor, Tensor]:
    """T and Y from the SVD, for a C of any rank, and the padding of T.

    Where ranks differ within the batch, the T of a higher rank gets zero columns; ``padding``
    ``(M, n_y)`` marks them, so that a unit curvature can pin their variables at zero. Y is then the
    pseudo-inverse: an inconsistent C z = b shows in the certificate.
    """
    M, n_c, n_z = C.shape
    n_rest = n_z - keep
    left, singular, right = torch.linalg.svd(C[:, :, keep:], full_matrices=True)
    scale = singular.amax(-1, keepdim=True) if singular.shape[-1] else singular.new_zeros(M, 1)
    significant = singular > RANK_TOLERANCE * scale
    rank = significant.sum(-1)
    lowest = int(rank.min()) if M else 0
    k = singular.shape[-1]
    inverse = torch.where(significant, 1 / singular, 0.0)
    pseudo_inverse = (right[:, :k].mT * inverse.unsqueeze(-2)) @ left[:, :, :k].mT
    padded = torch.arange(lowest, n_rest, device=C.device) < rank.unsqueeze(-1)
    basis = right[:, lowest:].mT * ~padded.unsqueeze(-2)
    identity = torch.eye(keep).to(C).expand(M, -1, -1)
    top = torch.cat((identity, C.new_zeros(M, keep, n_rest - lowest)), dim=-1)
    bottom = torch.cat((-pseudo_inverse @ C[:, :, :keep], basis), dim=-1)
    T = torch.cat((top, bottom), dim=-2)
    Y = torch.cat((C.new_zeros(M, keep, n_c), pseudo_inverse), dim=-2)
    padding = torch.cat((C.new_zeros(M, keep), padded.to(C)), dim=-1)
    return T, Y, padding
