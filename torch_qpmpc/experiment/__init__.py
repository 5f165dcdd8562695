"""The parts of train.py: configuration, tasks, run folders and sweeps."""

import torch_qpmpc.experiment.tasks  # noqa: F401 (registers those of the package)
