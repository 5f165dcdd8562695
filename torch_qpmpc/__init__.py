"""Quadratic programs as value functions, learned by Q-learning and readable as linear MPC."""

from torch_qpmpc import envs as envs
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.learning.gauss_newton import GaussNewton
from torch_qpmpc.learning.operators import QPActorValueOperator
from torch_qpmpc.learning.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.learning.q_learning import QPQLearningLoss
from torch_qpmpc.mpc.module import QPMPC
from torch_qpmpc.qp.pipeline.solve import SolveLog
from torch_qpmpc.qp.program import QuadraticProgram, Status
from torch_qpmpc.qp.solution import QPSolution
from torch_qpmpc.qp.solve import solve_qp

__all__ = [
    "QPMPC",
    "DeviationPenalty",
    "GaussNewton",
    "QPActorValueOperator",
    "QPError",
    "QPQLearningLoss",
    "QPSolution",
    "QuadraticProgram",
    "SolveLog",
    "SolverError",
    "Status",
    "SystemIdentificationPenalty",
    "solve_qp",
]
