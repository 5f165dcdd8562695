"""What a backend hands back: a claim, which the certificate judges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Answer:
    """v ``(B, d)``, signed row multipliers lam = eta - upsilon ``(B, r)``, iterations ``(B,)``.

    There is no status: the project's own certificate decides what is solved.
    """

    v: np.ndarray
    lam: np.ndarray
    iterations: np.ndarray
