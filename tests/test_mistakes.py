"""Error messages for users' mistakes: the argument, its value, the expected one and the remedy."""

from __future__ import annotations

import re
from typing import Any

import pytest
from hydra.errors import HydraException

import torch_qpmpc as qm
from tests.mistakes import learning, plants, programs, reading
from tests.mistakes.objects import A2, B1, W3, M, mpc, op
from tests.runs import make_config
from torch_qpmpc.envs import PointMass, PointMassEnv
from torch_qpmpc.learning.replay import Replay

TABLES = (programs.MISTAKES, learning.MISTAKES, reading.MISTAKES, plants.MISTAKES)


@pytest.mark.parametrize(
    ("beginning", "mistake"),
    [(text, call) for table in TABLES for text, calls in table.items() for call in calls],
)
def test_a_mistake_is_named(beginning, mistake):
    with pytest.raises(qm.QPError, match="^" + re.escape(beginning)):
        mistake()


MISSPELT: Any = {"misspelt": 1}


@pytest.mark.parametrize(
    "call",
    [
        M(**MISSPELT),
        lambda: qm.QPMPC.linear_mpc(A2, B1, 3, stage_weight=W3, **MISSPELT),
        lambda: qm.QPActorValueOperator(mpc, **MISSPELT),
        lambda: qm.QPQLearningLoss(op, **MISSPELT),
        lambda: qm.GaussNewton(mpc, **MISSPELT),
        lambda: qm.DeviationPenalty(mpc.C_0, 2, 1, **MISSPELT),
        lambda: qm.SystemIdentificationPenalty(**MISSPELT),
        lambda: PointMass(**MISSPELT),
        lambda: PointMassEnv(**MISSPELT),
        lambda: Replay(64, 2, 4, 3, 2, **MISSPELT),
    ],
)
def test_a_misspelt_keyword_is_named(call):
    with pytest.raises(TypeError, match="unexpected keyword argument 'misspelt'"):
        call()


@pytest.mark.parametrize(
    "make", [qm.QPMPC.from_model, lambda A, B, N, **x: qm.QPMPC.from_data({}, N, **x)]
)
def test_the_nearest_keyword_is_suggested(make):
    with pytest.raises(TypeError, match=r"'stage_weigth'; did you mean 'stage_weight'\?"):
        make([[1.0]], [[1.0]], 3, stage_weigth=[1.0, 0.1])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optimizer=adm", "Could not find 'optimizer/adm'"),
        ("constraint.deviation.c1=3", "Could not override 'constraint.deviation.c1'."),
    ],
)
def test_a_misspelt_override_is_named_by_hydra(override, message):
    with pytest.raises(HydraException, match=message):
        make_config(override)
