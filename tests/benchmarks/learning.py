"""The table of `docs/results/learning.md`: ``python -m tests.benchmarks.learning``.

It reads the runs of ``+study=actuator_noise``, ``inventory`` and ``short_horizon`` below runs/.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from tests.benchmarks.table import DOCS, ROOT
from torch_qpmpc.envs.closed_loop import cost_text
from torch_qpmpc.experiment.config import load_config
from torch_qpmpc.experiment.rivals.rival import IDENTIFICATION
from torch_qpmpc.experiment.run_folder import read_summary
from torch_qpmpc.study.markdown import replaced, table

PAGE = DOCS / "results" / "learning.md"
STUDIES = ("actuator_noise", "inventory", "short_horizon")
HEADER = (
    "task",
    "N",
    "start",
    "identification",
    "best without learning",
    "learned, median",
    "worst",
    "optimum",
    "share of the gap",
    "better",
    "p",
)


def runs(root: Path) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Return the summaries by task and horizon."""
    cases = defaultdict(list)
    for study in STUDIES:
        for path in sorted((root / f"study-{study}").glob("*/summary.json")):
            cfg, summary = load_config(path.parent / "config.yaml"), read_summary(path.parent)
            name = cfg.task.name.replace("_", " ")
            if "actuator_std" in cfg.task:
                name += f", std {cfg.task.actuator_std}"
            if cfg.algo.get("weighted") or study == "inventory":
                cases[name, cfg.task.horizon].append(summary)
    return cases


def row(summaries: list[dict[str, Any]]) -> list[str]:
    """Return the costs of a case, and the one-sided test that learning costs less."""
    identified = np.array([x["rivals"][IDENTIFICATION] for x in summaries])
    fair = np.array([min(x["J_start"], *x["rivals"].values()) for x in summaries])
    learned, start, optimum = (
        np.array([x[f"J_{name}"] for x in summaries]) for name in ("best", "start", "true_model")
    )
    share = np.median((fair - learned) / (fair - optimum))
    signed_rank: Any = wilcoxon(learned, fair, alternative="less")
    costs = (start, identified, fair, learned)
    return [
        *(cost_text(float(np.median(x))) for x in costs),
        cost_text(float(learned.max())),
        cost_text(float(np.median(optimum))),
        f"{share:.2f}",
        f"{(learned < fair).sum()} of {len(fair)}",
        f"{signed_rank.pvalue:.3f}",
    ]


def main() -> None:
    lines = [[name, str(N), *row(x)] for (name, N), x in sorted(runs(ROOT / "runs").items())]
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(page, table(HEADER, lines), "learning"), encoding="utf-8")


if __name__ == "__main__":
    main()
