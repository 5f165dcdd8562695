"""The public names, once for type checkers and for `__getattr__`."""

from torch_qpmpc import envs as envs
from torch_qpmpc.control.controller import Controller as Controller
from torch_qpmpc.control.linear_mpc import LinearMPC as LinearMPC
from torch_qpmpc.errors import QPError as QPError
from torch_qpmpc.errors import SolverError as SolverError
from torch_qpmpc.export.export import CompiledPolicy as CompiledPolicy
from torch_qpmpc.export.export import export_c as export_c
from torch_qpmpc.export.fmu import export_fmu as export_fmu
from torch_qpmpc.identification.identification import identify as identify
from torch_qpmpc.identification.learned import identify_nonlinear as identify_nonlinear
from torch_qpmpc.identification.reading import read_log as read_log
from torch_qpmpc.learning.closed_loop import improve as improve
from torch_qpmpc.learning.gauss_newton import GaussNewton as GaussNewton
from torch_qpmpc.learning.operators import QPActorValueOperator as QPActorValueOperator
from torch_qpmpc.learning.penalties import (
    DeviationPenalty as DeviationPenalty,
)
from torch_qpmpc.learning.penalties import (
    SystemIdentificationPenalty as SystemIdentificationPenalty,
)
from torch_qpmpc.learning.q_learning import QPQLearningLoss as QPQLearningLoss
from torch_qpmpc.learning.theta_network import ThetaNetwork as ThetaNetwork
from torch_qpmpc.mpc.bounds import Bounds as Bounds
from torch_qpmpc.mpc.cost import Cost as Cost
from torch_qpmpc.mpc.layout import Layout as Layout
from torch_qpmpc.mpc.model import Model as Model
from torch_qpmpc.mpc.module import QPMPC as QPMPC
from torch_qpmpc.mpc.nonlinear import RungeKutta as RungeKutta
from torch_qpmpc.mpc.scheme import Scheme as Scheme
from torch_qpmpc.qp.pipeline.solve import SolveLog as SolveLog
from torch_qpmpc.qp.program import QuadraticProgram as QuadraticProgram
from torch_qpmpc.qp.program import Status as Status
from torch_qpmpc.qp.solve import solve_qp as solve_qp
from torch_qpmpc.study.runs import load_run as load_run

__all__: list[str]
__version__: str
