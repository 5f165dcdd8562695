"""Parametrizations that keep the sign and structure of theta (`torch.nn.utils.parametrize`).

With H = L L' any gradient step on L leaves H positive semidefinite, so that the update of eq:thup
needs no semidefinite program (eq:sdp1). In a linear MPC scheme (eq:v1), C has only a model in its
band, and the stages share their values.
"""

import torch
from torch import Tensor, nn

from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.layout import Layout, banded_matrix
from torch_qpmpc.mpc.projections import CHOLESKY
from torch_qpmpc.mpc.validation import check_weight

#: The parts of theta whose sign a convex QP constrains.
SIGNED = ("H", "H_f", "w")


def parametrizations_for(
    name: str,
    value: Tensor,
    layout: Layout,
    structure: str,
    hessian: str,
    step: str,
    mask: Tensor | None = None,
) -> list[nn.Module]:
    """Return the parametrizations of a learned part of `QPMPC`: for structure, sign and mask.

    ``mask`` is True at the entries that are learned; None if all are.
    """
    chain, tied = [], structure == "tied"
    if tied and name in ("C", "G"):
        chain.append((Banded if name == "C" else LinearRows)(layout))
    if tied and name in ("q", "b", "lb", "ub", "w"):
        chain.append(Tied(name, layout.ties(name)))
    dense = hessian != "diagonal" and name != "w"
    if name in SIGNED and step == CHOLESKY:
        chain.append(Cholesky(layout.n_d) if dense else SquareRoot())
    elif name in ("H", "H_f"):
        chain.append(Symmetric(layout.n_d) if dense else Support(value))
    if mask is not None and not mask.all():
        _check_mask(name, mask, layout, chain)
        chain.append(Masked(mask, value))
    return chain


def make_hessian(
    layout: Layout, kind: str, stages: Tensor, terminal: Tensor, discount: Tensor
) -> Tensor:
    """Return H ``(n_z, n_z)`` (eq:qpH) from the weights of the ``stages`` and ``terminal``.

    Those of the ``kind`` "block" weight (d_k, x_k, u_k), one or N, and (d_N, x_N); a diagonal H has
    entries for the plan only. ``discount`` has an entry for each of z.
    """
    n_d, size = layout.n_d, layout.n_d + layout.n
    if kind == "diagonal":
        # Operations whose batched gradients (`GaussNewton`) are not a loop over the batch.
        before, plan = stages.new_zeros(layout.n_preview), stages.expand(layout.horizon, layout.n)
        return torch.diag_embed(discount * torch.cat((before, plan.flatten(), terminal)))
    blocks = (*stages.expand(layout.horizon, size, size), terminal)
    H = torch.block_diag(*(block[n_d:, n_d:] for block in blocks))
    if n_d:
        preview = torch.block_diag(*(block[:n_d, :n_d] for block in blocks))
        cross = torch.block_diag(*(block[:n_d, n_d:] for block in blocks))
        H = torch.cat((torch.cat((preview, cross), -1), torch.cat((cross.mT, H), -1)))
    root = discount.sqrt()
    return root.unsqueeze(-1) * H * root


class SquareRoot(nn.Module):
    """The Cholesky factor of a diagonal: non-negative entries ``h = l * l``, any shape.

    An entry that starts at exactly zero stays there, as its gradient is zero: the paper's
    diag(theta_1, .., theta_4, 0, 0) keeps its zero action weights.
    """

    def forward(self, factor: Tensor) -> Tensor:
        return factor * factor

    def right_inverse(self, value: Tensor) -> Tensor:
        """Return a factor of ``value``; raise `QPError` if an entry is negative."""
        check_weight("diagonal", value, diagonal=True, n_d=0)
        return value.sqrt()


class Support(nn.Module):
    """A diagonal, any shape, whose initial zeros stay zero, as with `SquareRoot`.

    An entry that a step has brought to zero can become positive again.
    """

    support: Tensor

    def __init__(self, start: Tensor) -> None:
        super().__init__()
        self.register_buffer("support", start != 0)

    def forward(self, entries: Tensor) -> Tensor:
        return self.support * entries

    def right_inverse(self, value: Tensor) -> Tensor:
        """Return ``value``; raise `QPError` if an entry is negative."""
        check_weight("diagonal", value, diagonal=True, n_d=0)
        return value


class Symmetric(nn.Module):
    """The symmetric part of matrices ``(*batch, n, n)``, whose gradient is symmetric, too.

    Its entries in the first ``n_free`` rows and columns are known variables' and have any sign.
    """

    def __init__(self, n_free: int = 0) -> None:
        super().__init__()
        self.n_free = n_free

    def forward(self, matrix: Tensor) -> Tensor:
        return (matrix + matrix.mT) / 2

    def right_inverse(self, value: Tensor) -> Tensor:
        """Return ``value``; raise `QPError` if its other block is not positive semidefinite."""
        check_weight("H", (value + value.mT) / 2, diagonal=False, n_d=self.n_free)
        return value


class Cholesky(nn.Module):
    """Positive semidefinite matrices ``H = L L'`` from lower triangular L, ``(*batch, n, n)``.

    With ``n_free``, H is ``[[P, S'], [S, L L']]`` with a symmetric P ``(n_free, n_free)`` and an S
    of any sign for known variables, from ``[[P, 0], [S, L]]``.
    """

    def __init__(self, n_free: int = 0) -> None:
        super().__init__()
        self.n_free = n_free

    def forward(self, factor: Tensor) -> Tensor:
        if not self.n_free:
            lower = factor.tril()
            return lower @ lower.mT
        n = self.n_free
        P, S, lower = factor[..., :n, :n], factor[..., n:, :n], factor[..., n:, n:].tril()
        upper = torch.cat(((P + P.mT) / 2, S.mT), dim=-1)
        return torch.cat((upper, torch.cat((S, lower @ lower.mT), dim=-1)), dim=-2)

    def right_inverse(self, value: Tensor) -> Tensor:
        """Return a factor of a possibly singular ``value``, by QR of a root in units of H_ii.

        In these no entry is rounding beside another, if rounding has left ``value`` definite there.
        """
        n = self.n_free
        check_weight("H", H := (value + value.mT)[..., n:, n:] / 2, diagonal=False, n_d=0)
        size = H.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
        size = torch.where(size > 0, size, 1).unsqueeze(-1)
        lowest = torch.linalg.eigvalsh(H / size / size.mT)[..., :1].unsqueeze(-1)
        size = size.masked_fill(lowest < -(torch.finfo(H.dtype).eps ** 0.5), 1)
        eigenvalues, vectors = torch.linalg.eigh(H / size / size.mT)
        root = size * vectors * eigenvalues.clamp(min=0).sqrt().unsqueeze(-2)
        upper = torch.linalg.qr(root.mT).R
        sign = torch.where(upper.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0)
        factor = value.clone()
        factor[..., :n, n:], factor[..., n:, n:] = 0, upper.mT * sign.unsqueeze(-2)
        return factor


class Masked(nn.Module):
    """A part of theta in which only the entries in ``mask`` are learned."""

    mask: Tensor
    frozen: Tensor

    def __init__(self, mask: Tensor, value: Tensor) -> None:
        super().__init__()
        self.cpu_mask = mask.numpy(force=True)  # as a tensor, `Leaves` would take it for theta
        self.place(value.device)
        self.register_buffer("frozen", value.detach().clone())

    def place(self, device: torch.device) -> None:
        """Put the mask on a device; a module moved to "meta" has lost it."""
        self.register_buffer("mask", torch.tensor(self.cpu_mask, device=device), persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        return torch.where(self.mask, value, self.frozen)

    def right_inverse(self, value: Tensor) -> Tensor:
        """Return ``value``, and freeze its entries outside the mask."""
        self.frozen.copy_(value.detach())
        return value


class Banded(nn.Module):
    """C of a model (eq:cband) from A, B and, with a preview, E; see `banded_matrix`."""

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self.layout = layout

    def forward(self, A: Tensor, B: Tensor, E: Tensor | None = None) -> Tensor:
        return banded_matrix(A, B, self.layout.horizon, E)

    def right_inverse(self, C: Tensor) -> tuple[Tensor, ...]:
        """Return the model in the band of C; raise `QPError` if C has other entries."""
        sizes = self.layout.n_d, self.layout.n_x, self.layout.n_u
        E, *model = (x.contiguous() for x in self.layout.stage_blocks(C)[0].split(sizes, dim=-1))
        model = (*model, *[E] * (sizes[0] > 0))
        _check_tied("C", C, self(*model))
        return model


class Tied(nn.Module):
    """A vector whose entry i is entry ``index[i]`` of a shorter one."""

    index: Tensor
    first: Tensor

    def __init__(self, name: str, index: Tensor) -> None:
        super().__init__()
        self.name, self.ties = name, index.tolist()
        self.place(index.device)

    def place(self, device: torch.device) -> None:
        """Put the index on a device; a module moved to "meta" has lost it."""
        first = [self.ties.index(i) for i in range(max(self.ties) + 1)]
        for name, index in (("index", self.ties), ("first", first)):
            self.register_buffer(name, torch.tensor(index, device=device), persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        return values[..., self.index]

    def right_inverse(self, entries: Tensor) -> Tensor:
        """Return the first of each group of tied entries; raise `QPError` if the others differ."""
        values = entries[self.first]
        _check_tied(self.name, entries, self(values))
        return values


class LinearRows(nn.Module):
    """G of mixed constraints (eq:v1c4): the plan, D for each stage and D^f for x_N.

    D is ``(n_mixed, n_d + n_x + n_u)``, and D^f ``(n_terminal, n_d + n_x)``.
    """

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self.layout = layout

    def forward(self, D: Tensor, D_f: Tensor) -> Tensor:
        layout = self.layout
        stages = layout.from_stage(D.expand(layout.horizon, *D.shape[-2:]))
        plan = torch.eye(layout.n_z)[layout.n_preview :].to(D)
        return torch.cat((plan, stages, layout.from_terminal(D_f)))

    def right_inverse(self, G: Tensor) -> tuple[Tensor, Tensor]:
        """Return D and D^f; raise `QPError` if G has other entries."""
        D, D_f = _linear_rows(G, self.layout)
        D, D_f = self.layout.stage_blocks(D)[0].contiguous(), self.layout.terminal_block(D_f)
        _check_tied("G", G, self(D, D_f))
        return D, D_f


def _check_mask(name: str, mask: Tensor, layout: Layout, chain: list[nn.Module]) -> None:
    """Raise `QPError` if a mask separates entries that the other parametrizations join."""
    what = f"learn[{name!r}]"
    if any(isinstance(part, Cholesky | Symmetric) for part in chain):
        want = "True, or a mask with hessian='diagonal'"
        raise QPError.expected(what, "a mask of a dense H", want, "H must stay semidefinite.")
    tied = True
    for part in chain:
        if isinstance(part, Tied):
            tied = torch.equal(mask, mask[part.first][part.index])
        elif isinstance(part, Banded | LinearRows):
            rows = _linear_rows(mask, layout)[0] if name == "G" else mask
            blocks = layout.stage_blocks(rows)
            tied = bool((blocks == blocks[:1]).all())
    if not tied:
        want = "one that is the same for all stages, which structure='tied' ties"
        raise QPError.expected(what, "a mask that differs between stages", want)


def _linear_rows(G: Tensor, layout: Layout) -> tuple[Tensor, Tensor]:
    """Return the rows of G that belong to D and to D^f."""
    mixed = layout.horizon * layout.n_mixed
    _, D, D_f = G.split((layout.n_z - layout.n_preview, mixed, layout.n_terminal))
    return D, D_f


def _check_tied(name: str, entries: Tensor, tied: Tensor) -> None:
    if not torch.equal(entries, tied):
        got = "entries that break the structure of a linear MPC scheme"
        remedy = "Call release() first to free them, or begin with structure='free'."
        raise QPError.expected(name, got, "entries that keep it", remedy)
