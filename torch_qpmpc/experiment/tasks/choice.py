"""The table of the starts that two logs allow; closed loops on the plant have chosen one."""

from __future__ import annotations

import io
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
NOTHING = (
    "No start is shown to cost less than zero action, which is the start. Perhaps no scheme "
    "of these logs controls the plant: pass a log about the states where the controller is to work "
    "(start.file), one of short episodes if the plant is unstable (task.episode_steps=20), the "
    "plant's own cost (task.stage_weight), or a theta from a network: 'Scheduled and nonlinear "
    "plants' in the guides."
)


class Row(NamedTuple):
    """A start, and True if it is the ``chosen`` one.

    ``J`` is the mean cost of its ``episodes``, ``error`` the standard error of that,
    ``transitions`` at most the number of their steps, and ``lasted`` the number without those
    after an episode's end.
    """

    episodes: int = 0
    J: float = 0.0
    error: float = 0.0
    transitions: int = 0
    lasted: float = 0.0
    chosen: bool = False


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
        """The name of the best start that is not zero action, with which learning begins."""
        return next(name for name, _ in self._ranked if name != ZERO_ACTION)

    @property
    def _ranked(self) -> list[tuple[str, Row]]:
        return sorted(self.rows.items(), key=lambda item: (-item[1].episodes, item[1].J))

    @property
    def transitions(self) -> int:
        """At most the number of steps of all closed loops."""
        return sum(row.transitions for row in self.rows.values())

    @property
    def summary(self) -> dict[str, Any]:
        """The entries of summary.json."""
        return {"start": self.name, "start_transitions": self.transitions}

    def __str__(self) -> str:
        width = max(map(len, self.rows))
        lines = [
            f"{'start':{width}}{'episodes':>10}  "
            "J +- standard error (compare rows of equal episodes)"
        ]
        for name, row in self._ranked:
            J = f"{cost_text(row.J)} +- {cost_text(row.error)}"
            lines.append(f"{name:{width}}{row.episodes:10}  {J}")
        chosen = self.rows[self.name]
        lines.append(
            f"Chosen by at most {self.transitions:,} transitions beside the logs': {self.name}"
        )
        if chosen.lasted < chosen.transitions:
            length, steps = (x / chosen.episodes for x in (chosen.lasted, chosen.transitions))
            lines.append(f"Its episodes end after {length:.0f} of {steps:.0f} steps in the mean.")
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
            exact = dict.fromkeys(("J", "error", "lasted"), float)  # pandas before 3.1 rounds
            table = pd.read_csv(file, index_col="start", converters=exact)
            choice = cls({str(name): Row(*row) for name, *row in table.itertuples()})
            _ = choice.name, choice.scheme
        except Exception as error:  # damaged files raise errors of any type
            raise damaged(file, error, "the table of starts that a run wrote") from error
        return choice
