"""``python -m torch_qpmpc.export RUN_FOLDER``: the learned policy of a finished run as C."""

from __future__ import annotations

import argparse
from pathlib import Path

from torch_qpmpc.errors import QPError
from torch_qpmpc.experiment.run_folder import C_FOLDER, CHECKPOINT, learned_qp
from torch_qpmpc.export.export import STORAGES, export_c
from torch_qpmpc.export.writer import REAL


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m torch_qpmpc.export",
        description="Write the learned policy of a finished run as C.",
    )
    parser.add_argument("run", type=Path, metavar="RUN_FOLDER", help="folder of the run")
    parser.add_argument("--folder", type=Path, help=f"folder of the C files; RUN_FOLDER/{C_FOLDER}")
    parser.add_argument("--dtype", choices=tuple(REAL), default="float64")
    parser.add_argument("--name", default="policy", help="beginning of all names in C")
    parser.add_argument("--max-iterations", type=int, help="limit of a step")
    parser.add_argument("--storage", choices=STORAGES, default="fast")
    options = vars(parser.parse_args(arguments))
    run, folder = options.pop("run"), options.pop("folder")
    try:
        if not (run / CHECKPOINT).exists():
            got = f"{run}, which has no {CHECKPOINT}"
            raise QPError.expected("RUN_FOLDER", got, "the folder of a run of train.py")
        print(export_c(learned_qp(run), folder or run / C_FOLDER, **options))
    except QPError as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
