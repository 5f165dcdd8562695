"""The parts of a log."""

import torch
from torch.testing import assert_close

from tests.logs import arx_log
from torch_qpmpc.identification.log import folds
from torch_qpmpc.identification.reading import as_log


def test_folds_hold_each_step_once():
    data = as_log(arx_log(), n_d=1).trajectories
    parts = folds(data, 7)
    sizes = [sum(trajectory.steps for trajectory in part) for part in parts]
    assert sum(sizes) == 120
    assert max(sizes) - min(sizes) <= 1
    actions = [trajectory.u for part in parts for trajectory in part]
    assert_close(torch.cat(actions), torch.cat([trajectory.u for trajectory in data]))
    assert all(len(t.y) == t.steps + 1 for part in parts for t in part)
