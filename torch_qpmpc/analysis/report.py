"""A report on the predictions and the policy of a QPMPC."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

from torch import Tensor

from torch_qpmpc.analysis.model_error import one_step_error
from torch_qpmpc.analysis.policy import local_gain, lqr_gain, spectral_radius, stage_weight
from torch_qpmpc.analysis.prediction_form import PredictionForm, canonical_matrix, prediction_form
from torch_qpmpc.analysis.structure import (
    Model,
    causality_defect,
    markov_order,
    memory_energies,
    nearest_model,
    stage_models,
    toeplitz_defect,
)
from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError
from torch_qpmpc.mpc.module import QPMPC


@dataclass(frozen=True, eq=False)
class StructureReport:
    """A QP's constraints as a prediction model, and its policy near a state.

    Attributes:
        form: the prediction form.
        nearest: the nearest time-invariant scheme (A, B, offset).
        stages: the model of each stage (A_k, B_k, offset_k).
        memory: `memory_energies`.
        K: the policy's gain at the state, ``(n_u, n_x)``, u_0 = pi(s) - K ds.
        K_lqr: the LQR gain of the nearest model and the stage weight, or None if the Riccati
            equation has no solution.
        condition: condition number of C's state columns.
        causality: `causality_defect`.
        toeplitz: `toeplitz_defect`.
        non_markov: share of the predictions' norm that the latest pair (x_k, u_k) does not explain.
        order: `markov_order`.
        distance_to_mpc: relative distance of the predictions to those of ``nearest``.
        gain_to_lqr: ``||K - K_lqr|| / ||K_lqr||``, or nan.
        radius_predicted: spectral radius of the nearest model's A - B K.
        radius: spectral radius of the true A - B K; nan without a true model, as are the next.
        model_error: `one_step_error` of ``nearest`` against the true model, with (s, a) of unit
            variance.
        model_error_max: largest difference of an entry of A or B.
        first_stage_error: ``model_error`` of A_0, B_0.
    """

    form: PredictionForm = field(repr=False)
    nearest: Model = field(repr=False)
    stages: Model = field(repr=False)
    memory: Tensor = field(repr=False)
    K: Tensor = field(repr=False)
    K_lqr: Tensor | None = field(repr=False)
    condition: float
    causality: float
    toeplitz: float
    non_markov: float
    order: float
    distance_to_mpc: float
    gain_to_lqr: float
    radius_predicted: float
    radius: float
    model_error: float
    model_error_max: float
    first_stage_error: float

    def scalars(self) -> dict[str, float]:
        """Return the numbers by name."""
        return {
            f.name: value for f in fields(self) if isinstance(value := getattr(self, f.name), float)
        }

    def __str__(self) -> str:
        lines = [f"{name:18}{value:12.4g}" for name, value in self.scalars().items()]
        matrices = {"A": self.nearest.A, "B": self.nearest.B, "K": self.K}
        for name, matrix in matrices.items():
            rows = ["  ".join(f"{entry:8.4f}" for entry in row) for row in matrix.tolist()]
            lines += [f"{name if i == 0 else '':4}{row}" for i, row in enumerate(rows)]
        return "\n".join(lines)


def predictions(mpc: QPMPC) -> PredictionForm:
    """Return the prediction form of the constraints, X = Phi x_0 + Gamma U + phi.

    Raises:
        QPError: if C has no prediction form.
    """
    return prediction_form(mpc.C, mpc.n_x, mpc.n_u, mpc.b)


def canonical(mpc: QPMPC) -> Tensor:
    """Return C ``(n_c, n_z)`` in the gauge in which an MPC scheme's is banded.

    Raises:
        QPError: if C has no prediction form.
    """
    form = predictions(mpc)
    return canonical_matrix(form, stage_models(form).A)[0]


def read(
    mpc: QPMPC, true_model: Sequence[Tensor] | None = None, at: Tensor | None = None
) -> StructureReport:
    """Read a QP: its constraints as a prediction model, and its policy near a state.

    Args:
        mpc: the QP.
        true_model: the plant's A, B and, if it has one, offset; None if they are unknown.
        at: the state of the policy's gain, ``(n_x,)``; the origin by default.

    Raises:
        QPError: if C has no prediction form, or an argument does not fit.
        SolverError: if the QP has no solution there, and ``mpc.on_failure`` is ``"raise"``.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> from torch_qpmpc.analysis.report import read
        >>> A, B = torch.tensor([[1.0, 0.1], [0.0, 0.9]]), torch.tensor([[0.0], [0.1]])
        >>> found = read(qm.QPMPC.linear_mpc(A, B, 10))
        >>> found.order, found.distance_to_mpc < 1e-9, round(found.radius_predicted, 2)
        (1.0, True, 0.97)
    """
    check_kind("mpc", mpc, QPMPC)
    if true_model is not None:
        true_model = _checked_model(mpc, true_model)
    if at is not None:
        check_tensor("at", at, mpc.n_x, batched=False)
    form = predictions(mpc)
    nearest, stages, memory = nearest_model(form), stage_models(form), memory_energies(form)
    K = local_gain(mpc, form.Phi.new_zeros(mpc.n_x) if at is None else at.to(form.Phi))
    try:
        K_lqr = lqr_gain(nearest.A, nearest.B, stage_weight(mpc), mpc.gamma)
    except QPError:
        K_lqr = None
    radius = error = largest = first = math.nan
    if true_model is not None:
        A, B, *offset = (part.to(form.Phi) for part in true_model)
        radius = spectral_radius(A, B, K).item()
        error = one_step_error(nearest, A, B, *offset).item()
        largest = max((nearest.A - A).abs().max().item(), (nearest.B - B).abs().max().item())
        first = one_step_error(stages, A, B, *offset)[0].item()
    return StructureReport(
        form=form,
        nearest=nearest,
        stages=stages,
        memory=memory,
        K=K,
        K_lqr=K_lqr,
        condition=form.condition.item(),
        causality=causality_defect(form).item(),
        toeplitz=toeplitz_defect(form).item(),
        non_markov=memory[1:].sum().sqrt().item(),
        order=markov_order(memory),
        distance_to_mpc=nearest.residual.item(),
        gain_to_lqr=math.nan if K_lqr is None else ((K - K_lqr).norm() / K_lqr.norm()).item(),
        radius_predicted=spectral_radius(nearest.A, nearest.B, K).item(),
        radius=radius,
        model_error=error,
        model_error_max=largest,
        first_stage_error=first,
    )


def structure_metrics(mpc: QPMPC, true_model: Sequence[Tensor] | None = None) -> dict[str, float]:
    """Return the numbers of `read` that measure the distance to an MPC scheme, for logs.

    Returns:
        ``causality_defect``, ``toeplitz_defect``, ``distance_to_mpc`` and, with a true model,
        ``model_error``; all nan if C has no prediction form, so that training continues.

    Raises:
        QPError: if an argument does not fit.
    """
    check_kind("mpc", mpc, QPMPC)
    if true_model is not None:
        true_model = _checked_model(mpc, true_model)
    names = ("causality_defect", "toeplitz_defect", "distance_to_mpc")
    names += () if true_model is None else ("model_error",)
    try:
        form = predictions(mpc)
    except QPError:
        return dict.fromkeys(names, math.nan)
    nearest = nearest_model(form)
    values = [causality_defect(form), toeplitz_defect(form), nearest.residual]
    if true_model is not None:
        values.append(one_step_error(nearest, *(part.to(form.Phi) for part in true_model)))
    return dict(zip(names, map(float, values), strict=True))


def _checked_model(mpc: QPMPC, true_model: Sequence[Tensor]) -> Sequence[Tensor]:
    """Return ``true_model``; raise `QPError` if it does not fit."""
    if not isinstance(true_model, tuple | list) or len(true_model) not in (2, 3):
        got = type(true_model).__name__
        got += f" of {len(true_model)}" if isinstance(true_model, tuple | list) else ""
        raise QPError.expected("true_model", got, "the pair (A, B), or (A, B, offset)")
    shapes = ((mpc.n_x, mpc.n_x), (mpc.n_x, mpc.n_u), (mpc.n_x,))
    for name, part, shape in zip(("A", "B", "offset"), true_model, shapes, strict=False):
        check_tensor(f"true_model's {name}", part, *shape, batched=False)
    return true_model
