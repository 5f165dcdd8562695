"""The table of the starts that a log allows; closed loops on the plant have chosen one."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import pandas as pd

from torch_qpmpc.experiment.costs import cost_text
from torch_qpmpc.experiment.rivals import ZERO_ACTION
from torch_qpmpc.files import damaged, write_whole

#: The table in a run's folder.
STARTS = "starts.csv"
MEAN_ACTION = "mean action of the log"
#: The starts that hold an action.
HELD = {ZERO_ACTION, MEAN_ACTION}
NO_WINDOW = "If one observation hides a part of the state, such as a velocity, try task.past=2."
NOTHING = (
    "No start is shown to cost less than zero action, which is the start. Perhaps no scheme "
    "of this log controls the plant: pass a log about the states where the controller is to work "
    "(start.file), one of short episodes if the plant is unstable (task.episode_steps=20), the "
    "plant's own cost (task.stage_weight), or a theta from a network: 'Scheduled and nonlinear "
    "plants' in the guides."
)


class Row(NamedTuple):
    """A start: its prediction, its episodes, and True if it is the ``chosen`` one.

    ``R2`` is the share of the outputs' variance that is predicted N steps ahead in parts of the log
    that are held out, in the mean over the outputs that the model does not hold; ``J`` the mean
    cost of the ``episodes``, ``error`` its standard error, and ``transitions`` at most the number
    of their steps: those that end early have fewer, in the mean ``length``. R2 is NaN for starts
    without such a prediction: those that hold an action, and one of single steps.
    """

    R2: float
    episodes: int
    J: float
    error: float
    transitions: int
    chosen: bool
    length: float = math.nan


@dataclass(frozen=True)
class Choice:
    """The rows of the starts by name; ``print`` shows them, best first."""

    rows: Mapping[str, Row]

    @property
    def name(self) -> str:
        """The name of the chosen start."""
        return next(name for name, row in self.rows.items() if row.chosen)

    @property
    def scheme(self) -> str:
        """The name of the best start that holds no action, with which learning begins."""
        best_first = (name for name, _ in self._ranked if name not in HELD)
        return next(best_first) if self.name in HELD else self.name

    @property
    def _ranked(self) -> list[tuple[str, Row]]:
        """The rows, best first; the run's own wins a tie."""
        return sorted(self.rows.items(), key=lambda item: (-item[1].episodes, item[1].J))

    @property
    def summary(self) -> dict[str, Any]:
        """The entries of summary.json."""
        return {"start": self.name, "start_transitions": self._transitions}

    @property
    def _transitions(self) -> int:
        return sum(row.transitions for row in self.rows.values())

    def __str__(self) -> str:
        width = max(map(len, self.rows))
        lines = [
            f"{'start':{width}}{'R2':>8}{'episodes':>10}  "
            "J +- standard error (compare rows of equal episodes)"
        ]
        for name, row in self._ranked:
            R2 = "" if math.isnan(row.R2) else f"{row.R2:.3f}" if row.R2 > -100 else "< -100"
            J = f"{cost_text(row.J)} +- {cost_text(row.error)}"
            lines.append(f"{name:{width}}{R2:>8}{row.episodes:10}  {J}")
        lines.append(
            f"Chosen by at most {self._transitions:,} transitions of the plant: {self.name}"
        )
        chosen = self.rows[self.name]
        if chosen.length < (steps := chosen.transitions / max(chosen.episodes, 1)):
            lines.append(
                f"Its episodes end after {chosen.length:.0f} of {steps:.0f} steps in the mean."
            )
        lines += [NO_WINDOW] * (not any("past=" in name for name in self.rows))
        return "\n".join(lines + [NOTHING] * (self.name == ZERO_ACTION))

    def write(self, folder: Path) -> None:
        """Write the table into a run's folder."""
        buffer = io.BytesIO()
        table = pd.DataFrame([*self.rows.values()], index=[*self.rows], columns=[*Row._fields])
        table.to_csv(buffer, index_label="start")
        write_whole(folder / STARTS, buffer.getbuffer())

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Read the table of a run; None if it has none.

        Raises:
            QPError: the table is damaged.
        """
        file = folder / STARTS
        if not file.exists():
            return None
        try:
            numbers = ("R2", "J", "error", "length")
            exact = dict.fromkeys(numbers, _number)  # pandas before 3.1 rounds
            table = pd.read_csv(file, index_col="start", converters=exact)
            choice = cls({str(name): Row(*row) for name, *row in table.itertuples()})
            _ = choice.name
        except Exception as error:  # damaged files raise errors of any type
            raise damaged(file, error, "the table of starts that a run wrote") from error
        return choice


def _number(text: str) -> float:
    """Return the number in a cell; nan if it is empty."""
    return float(text or "nan")
