"""The export of a run's learned policy (``export=c``)."""

from __future__ import annotations

import warnings
from pathlib import Path

from torch_qpmpc.errors import QPError
from torch_qpmpc.export.export import export_c
from torch_qpmpc.mpc.module import QPMPC

#: The folder of the C files in that of the run.
FOLDER = "c"


def export_run(mpc: QPMPC, path: Path, quiet: bool) -> None:
    """Write the policy as C into the run's folder; warn if that is not possible."""
    try:
        export = export_c(mpc, path / FOLDER)
    except QPError as error:
        # The run's results are worth more than its export, which can be repeated.
        warnings.warn(f"The policy is not exported. {error}", stacklevel=2)
        return
    if not quiet:
        print(f"\n{export}")
