"""A nonlinear model from a log: small networks, where they predict better than a linear model.

With v = [d; x; u] the change x_{k+1} - x_k and the stage cost l_k, if there is one, are the mean of
an ensemble of networks of v_k (Chua et al., 2018, "Deep reinforcement learning in a handful of
trials using probabilistic dynamics models"), or linear and convex quadratic in v_k. Each network is
trained without a part of the log; the errors there choose between smooth and sharp networks, and
decide for each entry. Networks of what the linear model leaves are worse where the log is thin.
"""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torch_qpmpc.errors import QPError
from torch_qpmpc.identification.identification import Identified, identify
from torch_qpmpc.identification.ridge import ridge

#: The networks, their width, and the steps, rate and batch of their training.
COUNT, WIDTH, STEPS, RATE, BATCH = 5, 64, 2500, 3e-3, 128
SHARPEST = 1.0, 10.0  # hidden units are silu(s x) / s, with s from 1 to the second for kinks
#: A network predicts an entry if it leaves less than this share of the linear model's mean square,
#: a sharp one if it does of a smooth one's; the cost of a nonlinear plant also near a tie with the
#: quadratic; and none that the linear model leaves less of than this share of its variance.
LEFT, TIED, EXACT = 0.9, 1.5, 1e-10
#: What changes in fewer steps, and then by its own spread, is held, as a set-point is.
RARE = 0.1


class LearnedModel(nn.Module):
    """The next state, and the stage cost if there is one; `identify_nonlinear` fits one.

    Args:
        middle, size: what standardises v, ``(n,)``.
        base: coefficients ``(n_features, m)`` of 1, v and, with a cost, the products of v's entries
            in the change of x and in the cost.
        n_x: the number of states.
        layers: weights and biases of the networks; none without any.
        left: the share of the linear model's mean square that networks leave, ``(m,)``.
    """

    middle: Tensor
    size: Tensor
    base: Tensor
    left: Tensor
    identified: Identified | None = None

    def __init__(
        self, middle: Any, size: Any, base: Any, n_x: int, layers: Any = (), left: Any = ()
    ) -> None:
        super().__init__()
        self.n_x, self.depth = int(n_x), len(layers)
        parts = {"middle": middle, "size": size, "base": base, "left": left}
        parts |= {f"layer_{i}": layer for i, layer in enumerate(layers)}
        for name, part in parts.items():
            self.register_buffer(name, torch.as_tensor(part, dtype=torch.float64).clone())

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `LearnedModel` by name."""
        layers = [getattr(self, f"layer_{i}") for i in range(self.depth)]
        parts = {name: getattr(self, name) for name in ("middle", "size", "base", "left", "n_x")}
        return parts | {"layers": layers}

    def forward(self, x: Tensor, u: Tensor, *d: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return the next x ``(*batch, n_x)``, and the stage cost ``(*batch,)`` if observed."""
        return self.folded()(x, u, *d)

    def folded(self) -> Callable[..., Any]:
        """Return `forward` with its weights in the units of w = [d; x; u], for call after call."""
        n, middle, size = len(self.middle), self.middle, self.size
        layers = [getattr(self, f"layer_{i}") for i in range(self.depth)]
        W, b, products = self.base[1 : 1 + n] / size.unsqueeze(-1), self.base[0], self.base[1 + n :]
        if layers:
            W_1, b_1, W_2, b_2, W_3, b_3 = layers
            K, b = len(W_2), b + b_3
            b_1, W_3 = (b_1 - middle / size @ W_1).view(K, 1, -1), W_3.view(K, -1, len(b))
            W_1 = (W_1 / size.unsqueeze(-1)).view(n, K, -1).transpose(0, 1)
        b, curved = b - middle @ W, bool(products.any())

        def step(x: Tensor, u: Tensor, *d: Tensor) -> Tensor | tuple[Tensor, Tensor]:
            w = torch.cat((*d, x, u), -1).to(middle)
            rows = w.reshape(-1, n)
            out = torch.addmm(b, rows, W)
            if layers:
                hidden = F.silu(torch.baddbmm(b_1, rows.expand(K, -1, -1), W_1))
                hidden = F.silu(torch.baddbmm(b_2, hidden, W_2))
                out = out + torch.bmm(hidden, W_3).sum(0)
            if curved:
                out = out + _products((rows - middle) / size) @ products
            out = out.reshape(*w.shape[:-1], out.shape[-1])
            after = x + out[..., : self.n_x]
            return (after, out[..., -1]) if out.shape[-1] > self.n_x else after

        return step


def identify_nonlinear(trajectories: Any, cost: Any = None) -> LearnedModel:
    """Learn the dynamics of a state from a log.

    Args:
        trajectories: as in `identify`: the outputs are the state. Or an `Identified`, whose
            filter's estimates are the state.
        cost: the stage cost of each step, ``(T,)``, if the model shall have one.

    Raises:
        QPError: as in `identify`, or there are few steps, or not as many costs as steps.

    Example:
        >>> import numpy as np, torch, torch_qpmpc as qm
        >>> u, y = np.random.default_rng(0).uniform(-1, 1, 200), np.zeros(201)
        >>> for t in range(200):
        ...     y[t + 1] = 0.9 * y[t] + 0.5 * u[t]
        >>> model = qm.identify_nonlinear({"y": y, "u": u})  # no network: the plant is linear
        >>> model(torch.ones(1), torch.ones(1))
        tensor([1.4000], dtype=torch.float64)
    """
    given = isinstance(trajectories, Identified)
    own = trajectories if given else identify(trajectories, order=0)
    data = own.log.trajectories
    if given:
        x = own.fit.model.estimates
        data = [(torch.as_tensor(x(*map(np.asarray, z))), *z[1:]) for z in data]
    parts = zip(*((y[:-1], y[1:], u, d) for y, u, d in data), strict=True)
    x, after, u, d = map(torch.cat, parts)
    seen = (x + after).isfinite().all(1)
    x, after, u, d = x[seen], after[seen], u[seen], d[seen]
    if cost is not None:
        cost = torch.as_tensor(cost, dtype=torch.float64).reshape(-1)
        if len(cost) != len(u):
            want = f"{len(u)}, one for each step with outputs before and after"
            raise QPError.expected("cost", f"{len(cost)} numbers", want)
    model = fit_learned(torch.cat((d, x, u), -1), x, after, cost)
    model.identified = own
    return model


def fit_learned(v: Tensor, x: Tensor, after: Tensor, cost: Tensor | None = None) -> LearnedModel:
    """Fit a model to transitions, in the order of time; raise `QPError` if there are few.

    They are v = [d; x; u] ``(T, n)``, the state x and the next one ``(T, n_x)``, and the stage
    costs ``(T,)``, if they are known.
    """
    if len(v) < 2 * COUNT:
        raise QPError.expected("trajectories", f"{len(v)} steps", f"at least {2 * COUNT}")
    v, target, n_x = v.double(), (after - x).double(), x.shape[1]
    middle, size = v.mean(0), v.std(0, correction=0)
    size = torch.where(size > 1e-12 * v.abs().amax(0), size, 1.0)
    often = (target != 0).double().mean(0)
    held = (often < RARE) & (target.square().mean(0) > often * x.double().var(0))
    target = target.masked_fill(held, 0.0)
    target = target if cost is None else torch.cat((target, cost.double().unsqueeze(-1)), -1)
    v = (v - middle) / size
    linear = torch.cat((torch.ones_like(v[:, :1]), v), 1)
    features = linear if cost is None else torch.cat((linear, _products(v)), 1)
    base = F.pad(ridge(linear, target[:, :n_x]), (0, 0, 0, features.shape[1] - linear.shape[1]))
    if cost is not None:
        base = torch.cat((base, _convex(linear, features, target[:, n_x:])), -1)
    mean, spread = target.mean(0), target.std(0, correction=0)
    rest = (target - features @ base).square().mean(0)
    wanted, layers, left = rest > EXACT * spread.square(), (), torch.ones_like(rest)
    if wanted.any():
        spread = torch.where(spread > 0, spread, 1.0)
        inputs, outputs = v.float(), ((target - mean) / spread * wanted).float()
        smooth, sharp = (_trained(inputs, outputs, sharpest) for sharpest in SHARPEST)
        share = (sharp[1] / smooth[1])[wanted].log().mean().exp()
        layers, error = sharp if share < LEFT else smooth
        left = torch.where(wanted, error * spread.square() / rest, 1.0)
        most = torch.where(torch.arange(len(left)) < n_x, LEFT, TIED)
        used = wanted * (left < most) * (left < LEFT).any()
        *hidden, W, b = layers
        last = W * spread * used, (b * spread + mean) * used
        layers, base = (*hidden, *last) if used.any() else (), base * ~used
    return LearnedModel(middle, size, base, n_x, layers, left)


def _products(v: Tensor) -> Tensor:
    rows, columns = torch.triu_indices(v.shape[-1], v.shape[-1], device=v.device)
    return v[..., rows] * v[..., columns]


def _convex(linear: Tensor, features: Tensor, cost: Tensor) -> Tensor:
    """Return coefficients of a convex quadratic cost, ``(n_features, 1)``."""
    n = linear.shape[1]
    rows, columns = torch.triu_indices(n - 1, n - 1)
    W = cost.new_zeros(n - 1, n - 1)
    W[rows, columns] = ridge(features, cost)[n:, 0]
    values, vectors = torch.linalg.eigh(W + W.mT)
    W = (vectors * values.clamp(min=0)) @ vectors.mT
    entries = (W[rows, columns] * torch.where(rows == columns, 0.5, 1.0)).unsqueeze(1)
    return torch.cat((ridge(linear, cost - features[:, n:] @ entries), entries))


def _trained(v: Tensor, target: Tensor, sharpest: float) -> tuple[list[Tensor], Tensor]:
    """Train each network without a part of the rows; return them as one, and their errors there."""
    generator = torch.Generator().manual_seed(0)
    sizes, layers = (v.shape[1], WIDTH, WIDTH, target.shape[1]), []
    s = sharpest ** torch.linspace(0, 1, WIDTH)
    for n, m in itertools.pairwise(sizes):
        layers += [torch.randn(COUNT, n, m, generator=generator) / n**0.5, torch.zeros(COUNT, 1, m)]

    def outputs(x: Tensor) -> Tensor:
        for i in range(0, len(layers), 2):
            x = torch.baddbmm(layers[i + 1], x, layers[i])
            x = F.silu(s * x) / s if i + 2 < len(layers) else x
        return x

    parts = torch.arange(len(v)) * 2 * COUNT // len(v)
    pools = [(parts != 2 * k).nonzero().squeeze(1) for k in range(COUNT)]
    adam = torch.optim.AdamW([x.requires_grad_() for x in layers], RATE, weight_decay=1e-4)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, STEPS)
    with torch.enable_grad():
        for _ in range(STEPS):
            draws = torch.rand(COUNT, BATCH, generator=generator)
            rows = torch.stack([p[(x * len(p)).long()] for p, x in zip(pools, draws, strict=True)])
            loss = (outputs(v[rows]) - target[rows]).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
            rate.step()
    with torch.no_grad():
        own = outputs(v.expand(COUNT, *v.shape))[parts // 2, torch.arange(len(v))]
        error = (own - target)[parts % 2 == 0].double().square().mean(0)
        W_1, b_1, W_2, b_2, W_3, b_3 = (x.double() for x in layers)
        first, column = ((W_1 * s).movedim(0, 1).flatten(1), (b_1 * s).flatten()), s.unsqueeze(1)
        last = (W_3 / column).flatten(0, 1) / COUNT, b_3.mean((0, 1))
        return [*first, W_2 / column * s, b_2 * s, *last], error
