"""What a figure shows, and a learned QP of the point mass to draw."""

import io
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure

from torch_qpmpc import QPMPC
from torch_qpmpc.envs import PointMass


def make_mpc(horizon: int = 4) -> QPMPC:
    physics = PointMass()
    A, B, theta = physics.corrupted(1)
    mpc = QPMPC.from_model(
        A,
        B,
        horizon,
        action_bounds=(physics.lb_a, physics.ub_a),
        stage_weight=torch.cat((theta, torch.zeros(2))),
        solver="daqp",
    )
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        mpc.C += 0.1 * torch.randn(mpc.C.shape, generator=generator, dtype=torch.float64)
    return mpc


def rendered(figure: Figure) -> np.ndarray:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=50)
    file.seek(0)
    image = plt.imread(file)
    assert np.ptp(image[..., :3]) > 0.5, "not blank"
    assert plt.get_fignums() == [], "nothing for pyplot to keep"
    return image


def image_of(axes: Any) -> np.ndarray:
    (image,) = axes.images
    return np.asarray(image.get_array())


def legend_of(axes: Any) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]
