"""``python -m torch_qpmpc.train``: train.py with its configs/, of the clone or of the wheel."""

import runpy

from torch_qpmpc.files import PACKAGED

FOLDER = PACKAGED if PACKAGED.exists() else PACKAGED.parents[1]


def main() -> None:
    """Run the command line; a script calls this after it has registered a task of its own."""
    runpy.run_path(str(FOLDER / "train.py"), run_name="__main__")


if __name__ == "__main__":
    main()
