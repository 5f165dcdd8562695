"""``python -m torch_qpmpc.report``: tables and figures of finished runs, by `study.report`."""

from torch_qpmpc.study.report import main

if __name__ == "__main__":
    main()
