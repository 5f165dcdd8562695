"""Tables of runs that never ran."""

import pandas as pd


def made_up(gaps: dict[tuple[str, str], list[float]]) -> pd.DataFrame:
    """Make up runs by noise and case; the last of each has no real gap."""
    rows = []
    for (noise, case), values in gaps.items():
        for seed, gap in enumerate(values, 1):
            row = {"sweep": "a", "noise": noise, "constraint": case, "label": case, "seed": seed}
            row |= {"closed_gap": gap, "real": seed < len(values), "canonical_distance": 0.1 * seed}
            row |= {"prediction_error": 0.02 * seed, "prediction_error_start": 0.05}
            row |= {"J_start": 285.04, "J_best": 50.0, "J_true_model": 46.97, "zeros_above": 1.0}
            row["radius"] = 0.9
            rows.append(row)
    return pd.DataFrame(rows)
