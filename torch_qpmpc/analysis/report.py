"""A report on the predictions and the policy of a QPMPC."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from torch_qpmpc.analysis.policy import local_gain, spectral_radius
from torch_qpmpc.analysis.structure import (
    NearestModel,
    PredictionForm,
    causality_defect,
    nearest_model,
    one_step_error,
    predictions,
    stage_models,
    toeplitz_defect,
)
from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.mpc.riccati import lqr_gain, stage_weight
from torch_qpmpc.mpc.validation import without_gradients

#: A, B, offset and E.
TrueModel = tuple[Tensor, Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class StructureReport:
    """A QP's constraints as a prediction model, and its policy near a state.

    Attributes:
        form: the prediction form.
        nearest: the nearest time-invariant scheme (A, B, E, offset).
        stages: the model of each stage (A_k, B_k, E_k, offset_k).
        K: the policy's gain at the state, ``(n_u, n_p)``, u_0 = pi(s) - K ds.
        K_lqr: the LQR gain of the nearest model and the stage weight, ``(n_u, n_x)``; None if the
            Riccati equation has no solution.
        condition: condition number of C's state columns.
        causality: `causality_defect`.
        toeplitz: `toeplitz_defect`.
        non_markov: share of the predictions' norm that the latest pair (x_k, u_k) does not explain.
        distance_to_mpc: relative distance of the predictions to those of ``nearest``.
        gain_to_lqr: ``||K - K_lqr|| / ||K_lqr||`` with K's part for x, or nan.
        radius_predicted: spectral radius of the nearest model's A - B K.
        radius: spectral radius of the true A - B K; nan without a true model, as is the next.
        model_error: `one_step_error` of ``nearest`` against the true model, with (s, a) of unit
            variance.
    """

    form: PredictionForm = field(repr=False)
    nearest: NearestModel = field(repr=False)
    stages: NearestModel = field(repr=False)
    K: Tensor = field(repr=False)
    K_lqr: Tensor | None = field(repr=False)
    condition: float
    causality: float
    toeplitz: float
    non_markov: float
    distance_to_mpc: float
    gain_to_lqr: float
    radius_predicted: float
    radius: float
    model_error: float

    def scalars(self) -> dict[str, float]:
        """Return the numbers by name."""
        return {
            f.name: value for f in fields(self) if isinstance(value := getattr(self, f.name), float)
        }

    def __str__(self) -> str:
        lines = [f"{name:18}{value:12.4g}" for name, value in self.scalars().items()]
        K = self.K[:, self.form.layout.n_preview :]
        matrices = {"A": self.nearest.A, "B": self.nearest.B, "E": self.nearest.E, "K": K}
        for name, matrix in matrices.items():
            if not matrix.numel():
                continue
            rows = ["  ".join(f"{entry:8.4f}" for entry in row) for row in matrix.tolist()]
            lines += [f"{name if i == 0 else '':4}{row}" for i, row in enumerate(rows)]
        return "\n".join(lines)


@without_gradients
def read(
    mpc: QPMPC, true_model: Sequence[Tensor] | None = None, at: Tensor | None = None
) -> StructureReport:
    """Read a QP: its constraints as a prediction model, and its policy near a state.

    Args:
        mpc: the QP.
        true_model: the plant's A and B, ``(n_x, n_x)`` and ``(n_x, n_u)``, and, if it has them,
            offset and E ``(n_x, n_d)``; None if unknown: `read` never looks them up.
        at: the state of the policy's gain, ``(n_p,)``; the origin by default.

    Raises:
        QPError: if C has no prediction form, if there are dynamics, or if an argument does not fit.
        SolverError: if the QP has no solution there, and ``mpc.on_failure`` is ``"raise"``.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from torch_qpmpc.analysis.report import read
        >>> A, B = torch.tensor([[1.0, 0.1], [0.0, 0.9]]), torch.tensor([[0.0], [0.1]])
        >>> reading = read(qm.QPMPC.from_model(A, B, 9, stage_weight=[1.0] * 3, hessian="block"))
        >>> reading.distance_to_mpc < 1e-9, round(reading.radius_predicted, 2)
        (True, 0.97)
    """
    check_kind("mpc", mpc, QPMPC)
    true = None if true_model is None else _checked_model(mpc, true_model)
    if at is not None:
        check_tensor("at", at, mpc.n_p, batched=False)
    form = predictions(mpc)
    nearest, stages = nearest_model(form), stage_models(form)
    energies = form.maps[1:, :, :-1].square().sum((-1, -2))
    left = (stages.residual.square() * energies).sum() / energies.sum()
    K = local_gain(mpc, form.Phi.new_zeros(mpc.n_p) if at is None else at.to(form.Phi))
    K_x = K[:, form.layout.n_preview :]
    try:
        K_lqr = lqr_gain(nearest.A, nearest.B, stage_weight(mpc), mpc.gamma)
    except QPError:
        K_lqr = None
    radius = error = gain_error = math.nan
    if K_lqr is not None:
        gain_error = ((K_x - K_lqr).norm() / K_lqr.norm()).item()
    if true is not None:
        A, B, offset, E = true
        radius = spectral_radius(A, B, K_x).item()
        error = one_step_error(nearest, A, B, offset, E=E).item()
    return StructureReport(
        form=form,
        nearest=nearest,
        stages=stages,
        K=K,
        K_lqr=K_lqr,
        condition=form.condition.item(),
        causality=causality_defect(form).item(),
        toeplitz=toeplitz_defect(form).item(),
        non_markov=left.sqrt().item(),
        distance_to_mpc=nearest.residual.item(),
        gain_to_lqr=gain_error,
        radius_predicted=spectral_radius(nearest.A, nearest.B, K_x).item(),
        radius=radius,
        model_error=error,
    )


@without_gradients
def structure_metrics(mpc: QPMPC) -> dict[str, float]:
    """Return the numbers of `read` that measure the distance to an MPC scheme, for logs.

    They are nan, so that training continues, if C has no prediction form or dynamics replace it.
    """
    check_kind("mpc", mpc, QPMPC)
    names = ("causality_defect", "toeplitz_defect", "distance_to_mpc")
    try:
        form = predictions(mpc)
    except QPError:
        return dict.fromkeys(names, math.nan)
    values = causality_defect(form), toeplitz_defect(form), nearest_model(form).residual
    return dict(zip(names, map(float, values), strict=True))


def _checked_model(mpc: QPMPC, true_model: Sequence[Tensor]) -> TrueModel:
    """Return the true A, B, offset and E; raise `QPError` if one does not fit."""
    names = ("A", "B", "offset", "E")
    if not isinstance(true_model, tuple | list) or len(true_model) not in (2, 3, 4):
        got = type(true_model).__name__
        got += f" of {len(true_model)}" if isinstance(true_model, tuple | list) else ""
        want = "the pair (A, B), (A, B, offset) or (A, B, offset, E)"
        raise QPError.expected("true_model", got, want)
    n_x, n_u = mpc.n_x, mpc.n_u
    shapes = ((n_x, n_x), (n_x, n_u), (n_x,), (n_x, mpc.n_d))
    for name, part, shape in zip(names, true_model, shapes, strict=False):
        check_tensor(f"true_model's {name}", part, *shape, batched=False)
    zeros = [torch.zeros(shape) for shape in shapes[len(true_model) :]]
    A, B, offset, E = (part.to("cpu", torch.float64) for part in (*true_model, *zeros))
    return A, B, offset, E
