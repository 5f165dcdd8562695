"""Ridge regression in the units of the columns, with a strength that the data choose."""

import torch
from torch import Tensor

#: The strengths among which the evidence decides, relative to the mean square of a column.
STRENGTHS = 10.0 ** torch.arange(-16, 4.1, 0.25, dtype=torch.float64)
#: The share of that strength that is used. A ridge trades bias for variance; all coefficients of a
#: signal are biased the same way, which misleads a controller more than their noise.
SHARE = 0.3


def ridge(X: Tensor, Y: Tensor, strengths: Tensor = STRENGTHS, share: float = SHARE) -> Tensor:
    """Return the W that minimises ``|Y - X W|^2 / n + strength |D W|^2``, ``(m, n_y)``.

    D holds the root mean squares of X's columns, so that W does not depend on their units. The
    strength is ``share`` of the one with the largest evidence, the likelihood of Y ``(n, n_y)``
    under a Gaussian prior of W, for each column of Y by itself; the variance of the noise has its
    likeliest value. X is ``(n, m)``, and the evidence decides among ``strengths``.
    """
    n, m = X.shape
    size = X.square().mean(0).sqrt()
    scale = torch.where(size > 0, 1 / size, 0.0)
    rows = torch.cat((X * scale, Y), 1)
    if n > m:  # the triangular factor has the same singular values, and fewer rows
        rows = torch.linalg.qr(rows, mode="r").R
    basis, target = rows[:m].split((m, Y.shape[1]), 1)
    outside = rows[m:, m:].square().sum(0)
    U, s, Vh = torch.linalg.svd(basis, full_matrices=False)
    a = U.mT @ target
    outside = outside + (target - U @ a).square().sum(0)
    gain = 1 + s.square() / (n * strengths.unsqueeze(-1))
    noise = outside + (a.square() / gain.unsqueeze(-1)).sum(1)
    tiny = torch.finfo(s.dtype).tiny
    log_evidence = -n * noise.clamp(min=tiny).log() - gain.log().sum(1).unsqueeze(-1)
    shrinkage = share * strengths[log_evidence.argmax(0)]
    seen = (s > s.amax() * max(n, m) * torch.finfo(s.dtype).eps).unsqueeze(-1)
    s = s.unsqueeze(-1)
    inverse = torch.where(seen, s / (s.square() + n * shrinkage), 0.0)
    return scale.unsqueeze(-1) * (Vh.mT @ (inverse * a))
