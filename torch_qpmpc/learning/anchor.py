"""An anchor: a quadratic pull of C towards the one that was identified from a log.

A row c of C that predicts an output with the error variance v has, after a log of windows tau,
the log posterior

    -1/2 (c - c_0)' S (c - c_0) / v + const,    S = sum tau tau'.

Its negative, times a weight, is the pull. Directions of C that the log determines well stay near
C_0; those that it does not excite are free to learn. The SI penalty (eq:sdp3) is a pull towards
zero, with v = 1.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_qpmpc.checks import check_number
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.identification import Identified
from torch_qpmpc.mpc.predictor import outputs_in, windows

#: The smallest error variance, as a fraction of the output's mean square.
FLOOR = 1e-8


class Anchor(NamedTuple):
    """The penalty ``1/2 sum_i weights_i (c_i - c_0i)' S (c_i - c_0i)`` of the rows c_i of C.

    Attributes:
        C_0: ``(n_c, n_z)``.
        S: ``(n_z, n_z)``.
        weights: ``(n_c,)``.
    """

    C_0: Tensor
    S: Tensor
    weights: Tensor

    @classmethod
    def of(cls, identified: Identified, beta: float = 1.0, *, b_learned: bool = False) -> Anchor:
        """Return the anchor at an identified C.

        Args:
            identified: the C, b and the log.
            beta: the weight; with 1, the log's windows count as those of a likelihood.
            b_learned: leave b free: S is then the second moment of the windows about their mean.

        Raises:
            QPError: beta is not positive, or no trajectory of the log has N + L steps.
        """
        check_number("beta", beta, lambda x: 0 < x < torch.inf, "a finite number > 0")
        layout, (C_0, b) = identified.options.layout, identified.constraints
        # The last N windows of a trajectory end after it.
        logged = [windows(log, layout)[: -layout.horizon] for log in identified.data]
        Z = torch.cat(logged)
        if not len(Z):
            steps = layout.past + layout.horizon
            got = f"trajectories of at most {max(log.steps for log in identified.data)} steps"
            remedy = "Collect longer episodes, or shorten the horizon."
            raise QPError.expected("identified", got, f"at least {steps} steps", remedy)
        error = (Z @ C_0.mT - b).unflatten(-1, (-1, layout.n_x)).square().mean((0, 1))
        size = Z[:, outputs_in(layout)].square().mean((0, 1))
        variance = error.maximum(FLOOR * size).clamp(min=torch.finfo(size.dtype).tiny)
        if b_learned:
            Z = Z - Z.mean(0)
        return cls(C_0, Z.mT @ Z, (beta / variance).repeat(layout.horizon))

    def times(self, factor: Tensor | float) -> Anchor:
        """Return the penalty times ``factor``."""
        return self._replace(weights=factor * self.weights)

    def gradient(self, C: Tensor) -> Tensor:
        """Return the gradient ``(n_c, n_z)`` at C."""
        return self.weights.unsqueeze(-1) * ((C - self.C_0) @ self.S)

    def value(self, C: Tensor) -> Tensor:
        """Return the penalty of C ``(n_c, n_z)``, a scalar."""
        return 0.5 * ((C - self.C_0) * self.gradient(C)).sum()
