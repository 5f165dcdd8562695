"""Quadratic programs as value functions, learned by Q-learning and readable as linear MPC."""

from torch_qpmpc import envs as envs
from torch_qpmpc.autograd import solve_qp
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.gauss_newton import GaussNewton
from torch_qpmpc.mpc import QPMPC
from torch_qpmpc.objectives import QPQLearningLoss
from torch_qpmpc.operators import QPActorValueOperator
from torch_qpmpc.penalties import DeviationPenalty, SystemIdentificationPenalty
from torch_qpmpc.qp import QPSolution, QuadraticProgram, Status
from torch_qpmpc.solvers.chain import SolveLog

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
