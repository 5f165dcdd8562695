"""Environments whose episodes start at different steps."""

from __future__ import annotations

from typing import Any

import torch


class Staggered:
    """Makes episodes of a vectorised environment start at different steps.

    Every later reset is then partial. It comes before the environment among the bases.
    """

    batch_size: torch.Size
    max_steps: int

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> Any:
        out = super()._reset(tensordict, **kwargs)  # pyright: ignore[reportAttributeAccessIssue]
        if tensordict is None or "_reset" not in tensordict:
            out["step_count"] = torch.arange(self.batch_size[0]).unsqueeze(-1) % self.max_steps
        return out
