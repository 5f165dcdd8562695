"""Tables of runs that never ran."""

from __future__ import annotations

import pandas as pd


def made_up(gaps: dict[tuple[str, str], list[float]]) -> pd.DataFrame:
    """Make up runs by noise and case; the last of each has no real gap."""
    rows = []
    for (noise, case), values in gaps.items():
        for seed, gap in enumerate(values, 1):
            row = {"sweep": "a", "noise": noise, "constraint": case, "label": case, "seed": seed}
            row |= {"closed_gap": gap, "real": seed < len(values), "canonical_distance": 0.1 * seed}
            row |= {"zeros_above": 1.0}
            row |= {"prediction_error": 0.02 * seed, "prediction_error_start": 0.05}
            for name in ("J", "J_discounted"):
                row |= {f"{name}_start": 285.04, f"{name}_best": 50.0, f"{name}_true_model": 46.97}
            rows.append(row | {"unsolved": 0, "train_seconds": 3.21})
    return pd.DataFrame(rows)
