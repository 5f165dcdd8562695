"""Linear models at a few centres, blended by the observation, from a log.

The model of a nonlinear plant is

    x_{k+1} = sum_i w_i(x_k) (A_i x_k + B_i u_k + c_i),   w(x) = softmax(-|z - z_i|^2 / (2 h^2)),

with the standardised observation z and the centres z_i of k-means (Johansen and Foss, 1993,
"Constructing NARMAX models using ARMAX models"; Takagi and Sugeno, 1985). Each local model is
fitted to all transitions, weighted by w_i, with a ridge on its change from the linear model of all.
h is the mean distance of a centre from its nearest one. A controller linearises the model at s.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from numbers import Integral
from typing import Any

import torch
from torch import Tensor, nn

from torch_qpmpc.checks import check_tensor, check_whole
from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.identification import check_excitation
from torch_qpmpc.identification.log import Trajectory, complete, folds
from torch_qpmpc.identification.reading import as_log
from torch_qpmpc.identification.ridge import ridge
from torch_qpmpc.mpc.layout import Layout, banded_matrix
from torch_qpmpc.mpc.parameters import for_each
from torch_qpmpc.mpc.validation import as_tensor

#: The numbers of centres among which the held-out prediction decides.
CENTRES = (1, 2, 4, 8, 16, 32)
#: The log is cut into this many parts; the last one is held out.
PARTS = 5
#: The ridge on the changes of a local model, relative to the mean square of a regressor in the log.
RIDGE = 1e-3
#: The distances of the rows of two matrices, exactly zero for equal ones.
distance = partial(torch.cdist, compute_mode="donot_use_mm_for_euclid_dist")


class BlendedModel(nn.Module):
    """Linear models at centres, blended by the observation; `identify_blended` fits one.

    Args:
        centres: z_i, ``(m, n_x)``, in standardised units.
        middle, size: the mean and the deviation that standardise x, ``(n_x,)``.
        width: h.
        A, B, offset: the local models, ``(m, n_x, n_x)``, ``(m, n_x, n_u)`` and ``(m, n_x)``.

    Attributes:
        R2: the share of the outputs' variance that is predicted ``horizon`` steps ahead in the
            held-out part of the log, by the number of centres; empty in a loaded model.
    """

    centres: Tensor
    middle: Tensor
    size: Tensor
    width: Tensor
    A: Tensor
    B: Tensor
    offset: Tensor

    def __init__(
        self, centres: Any, middle: Any, size: Any, width: Any, A: Any, B: Any, offset: Any
    ) -> None:
        super().__init__()
        arguments = (centres, middle, size, width, A, B, offset)
        parts = {
            name: as_tensor(name, part).detach().clone()
            for name, part in zip(BlendedModel.__annotations__, arguments, strict=True)
        }
        (m, n_x), n_u = (*parts["centres"].shape, 0, 0)[:2], (0, *parts["B"].shape)[-1]
        shapes = ((m, n_x), (n_x,), (n_x,), (), (m, n_x, n_x), (m, n_x, n_u), (m, n_x))
        for (name, part), shape in zip(parts.items(), shapes, strict=True):
            if part.shape != shape:
                raise QPError.expected(name, f"shape {tuple(part.shape)}", f"shape {shape}")
            self.register_buffer(name, part)
        self.R2: dict[int, float] = {}

    def weights(self, s: Tensor) -> Tensor:
        """Return w ``(*batch, m)`` at s ``(*batch, n_x)``."""
        return (-self._distances(s).square().sum(-1) / 2).softmax(-1)

    def forward(self, s: Tensor, u: Tensor) -> Tensor:
        """Return the next x ``(*batch, n_x)``, in float64, for u ``(*batch, n_u)``."""
        u = check_tensor("u", u, self.B.shape[-1]).to(self.B)
        local = self._drift(s) + torch.einsum("ijk,...k->...ij", self.B, u)
        return (self.weights(s).unsqueeze(-1) * local).sum(-2)

    def linearised(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return A, B and the offset of the linearisation at (s, 0), with s ``(*batch, n_x)``."""
        local, w = self._drift(s), self.weights(s)
        ahead = (w.unsqueeze(-1) * local).sum(-2)
        # dw_i = w_i (de_i - sum_j w_j de_j), with the exponents e of the softmax.
        slopes = -self._distances(s) / (self.width * self.size)
        slopes = w.unsqueeze(-1) * (slopes - (w.unsqueeze(-1) * slopes).sum(-2, keepdim=True))
        A = torch.einsum("...i,ijk->...jk", w, self.A) + local.mT @ slopes
        B = torch.einsum("...i,ijk->...jk", w, self.B)
        return A, B, ahead - (A @ s.to(A).unsqueeze(-1)).squeeze(-1)

    def constraints(self, s: Tensor, horizon: int) -> tuple[Tensor, Tensor]:
        """Return C ``(*batch, N n_x, n_z)`` and b ``(*batch, N n_x)`` at s (eq:cband)."""
        A, B, offset = self.linearised(s)
        C = for_each(partial(banded_matrix, horizon=horizon), (A, B), (2, 2))
        return C, -torch.cat([offset] * horizon, -1)

    @property
    def arguments(self) -> dict[str, Tensor]:
        """The arguments of `BlendedModel` by name."""
        return dict(self.named_buffers())

    def extra_repr(self) -> str:
        return f"centres={len(self.centres)}, n_x={self.B.shape[-2]}, n_u={self.B.shape[-1]}"

    def _distances(self, s: Tensor) -> Tensor:
        """Return s minus the centres in units of h, ``(*batch, m, n_x)``."""
        z = (s.to(self.middle) - self.middle) / self.size
        return (z.unsqueeze(-2) - self.centres) / self.width

    def _drift(self, s: Tensor) -> Tensor:
        """Return the prediction of each local model without an action, ``(*batch, m, n_x)``."""
        s = check_tensor("s", s, self.B.shape[-2]).to(self.A)
        return torch.einsum("ijk,...k->...ij", self.A, s) + self.offset


def schedule_of(model: BlendedModel | Mapping[str, Tensor], layout: Layout) -> BlendedModel:
    """Return a copy of ``model``, or of one with these arguments, for the sizes ``layout``."""
    if isinstance(model, BlendedModel):
        own = copy.deepcopy(model)
    elif isinstance(model, Mapping) and {*model} == {*BlendedModel.__annotations__}:
        own = BlendedModel(**model)
    else:
        got = f"keys {', '.join(map(str, model))}" if isinstance(model, Mapping) else repr(model)
        remedy = "identify_blended returns one."
        raise QPError.expected("schedule", got, "a BlendedModel, or its arguments", remedy)
    sizes = (layout.n_x, layout.n_u, layout.n_d)
    if sizes != (found := (*own.B.shape[-2:], 0)):
        got, expected = (f"n_x, n_u, n_d = {x}" for x in (found, sizes))
        raise QPError.expected("schedule", got, f"{expected}, as the QPMPC")
    return own


def identify_blended(
    trajectories: Any, horizon: int, centres: int | Sequence[int] = CENTRES
) -> BlendedModel:
    """Fit linear models at a few centres to logged trajectories.

    Args:
        trajectories: as in `identify`, without known signals.
        horizon: the number of steps over which predictions decide on the number of centres.
        centres: the number of centres; or several, among which the last fifth of the log decides.
            Numbers with more coefficients than the log has transitions are left out.

    Raises:
        QPError: an argument is invalid, the log has known signals, or does not determine a linear
            model, as in `identify`.

    Example:
        >>> import numpy as np, torch, torch_qpmpc as qm
        >>> u, y = np.random.default_rng(0).uniform(-1, 1, 400), np.zeros(401)
        >>> for t in range(400):
        ...     y[t + 1] = np.sin(y[t]) + 0.5 * u[t]
        >>> model = qm.identify_blended({"y": y, "u": u}, horizon=3)
        >>> A, B, offset = model.linearised(torch.tensor([[0.0], [1.0]]))
        >>> bool(A[0] > 0.9), bool(A[1] < 0.7)  # the slopes of the sine, 1 and 0.54
        (True, True)
    """
    check_whole("horizon", horizon, 1)
    counts: Any = [int(centres)] if isinstance(centres, Integral) else centres
    for count in counts or (None,):
        check_whole("centres", count, 1)
    log = as_log(trajectories)
    if log.known:
        got = f"known signals {', '.join(log.known)}"
        raise QPError.expected("trajectories", got, "outputs and actions only")
    layout = Layout(len(log.outputs), len(log.inputs), int(horizon))
    check_excitation(log)
    data, coefficients = complete(log.trajectories), layout.n + 1
    if isinstance(centres, Integral):
        return _fit(data, layout, int(centres))
    counts = [count for count in counts if count * coefficients < log.steps] or [min(counts)]
    *parts, last = folds(data, PARTS)
    rest = [steps for part in parts for steps in part]
    variance = torch.cat([steps.y for steps in data]).var(0, correction=0)
    R2 = {count: _R2(_fit(rest, layout, count), last, horizon, variance) for count in counts}
    model = _fit(data, layout, max(R2, key=lambda count: R2[count]))
    model.R2 = R2
    return model


def _fit(data: Sequence[Trajectory], layout: Layout, count: int) -> BlendedModel:
    """Fit ``count`` local models."""
    X = torch.cat([torch.cat((steps.y[:-1], steps.u), -1) for steps in data])
    Y = torch.cat([steps.y[1:] for steps in data])
    x, n_x = X[:, : layout.n_x], layout.n_x
    Y = Y - x  # an output that never changes stays where it is
    middle, size = x.mean(0), x.std(0, correction=0)
    size = torch.where(size > 1e-12 * x.abs().amax(0), size, 1.0)
    centres = _centres((x - middle) / size, count)
    apart = distance(centres, centres).fill_diagonal_(torch.inf)
    width = apart.amin(1).mean() if len(centres) > 1 else size.new_ones(())
    X = torch.cat((X, torch.ones_like(X[:, :1])), -1)
    scale = X.square().mean(0).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    X = X / scale
    shared = ridge(X, Y)
    m, n_u = len(centres), layout.n_u
    A, B = x.new_zeros(m, n_x, n_x), x.new_zeros(m, n_x, n_u)
    w = BlendedModel(centres, middle, size, width, A, B, centres).weights(x)
    gram = torch.einsum("ti,tj,tk->ijk", w, X, X) / len(X)
    moment = torch.einsum("ti,tj,tk->ijk", w, X, Y - X @ shared) / len(X)
    strength = RIDGE * torch.eye(X.shape[1], dtype=X.dtype)
    local = shared + torch.linalg.solve(gram + strength, moment)
    A, B, offset = (local / scale.unsqueeze(-1)).mT.split((n_x, n_u, 1), -1)
    A = A + torch.eye(n_x).to(A)
    return BlendedModel(centres, middle, size, width, A, B, offset[..., 0])


def _centres(z: Tensor, count: int) -> Tensor:
    """Return the centres of k-means of z ``(T, n_x)``, at most ``count``, which differ."""
    chosen = z[z.square().sum(1).argmin()].unsqueeze(0)
    while len(chosen) < count:
        apart, farthest = distance(z, chosen).amin(1).max(0)
        if apart == 0:
            break
        chosen = torch.cat((chosen, z[farthest].unsqueeze(0)))
    from scipy.cluster.vq import kmeans2  # a tenth of a second, which few imports need

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a centre without members stays
        chosen = kmeans2(z.numpy(), chosen.numpy(), 50, minit="matrix")[0]
    return torch.as_tensor(chosen)


def _R2(model: BlendedModel, data: Sequence[Trajectory], horizon: int, variance: Tensor) -> float:
    """Return R2 of predictions ``horizon`` steps ahead, or as many as the longest of ``data``."""
    horizon, errors = min(horizon, max(steps.steps for steps in data)), []
    for steps in data:
        starts = max(steps.steps - horizon + 1, 0)
        x = steps.y[:starts]
        for k in range(horizon if starts else 0):
            x = model(x, steps.u[k : k + starts])
        errors.append(steps.y[steps.steps + 1 - starts :] - x)
    R2 = 1 - torch.cat(errors).square().mean(0) / torch.where(variance == 0, 1.0, variance)
    return R2[~variance.isnan()].mean().nan_to_num(-torch.inf).item()
