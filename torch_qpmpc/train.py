"""``python -m torch_qpmpc.train``: train.py with its configs/, of the clone or of the wheel."""

import runpy
from pathlib import Path

#: The wheel's copies of train.py and configs/ are here; in a clone they are beside the package.
PACKAGED = Path(__file__).with_name("command")
FOLDER = PACKAGED if PACKAGED.exists() else Path(__file__).parents[1]


def main() -> None:
    """Run the command line; a script calls this after it has registered a task of its own."""
    runpy.run_path(str(FOLDER / "train.py"), run_name="__main__")


if __name__ == "__main__":
    main()
