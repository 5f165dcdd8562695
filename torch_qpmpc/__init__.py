"""Quadratic programs as value functions, learned by Q-learning and readable as linear MPC."""

import pkgutil
from typing import TYPE_CHECKING, Any

import gymnasium

from torch_qpmpc.errors import QPError, SolverError

if TYPE_CHECKING:
    from torch_qpmpc import envs as envs
    from torch_qpmpc.control.controller import Controller
    from torch_qpmpc.control.linear_mpc import LinearMPC
    from torch_qpmpc.export.export import CompiledPolicy, export_c
    from torch_qpmpc.export.fmu import export_fmu
    from torch_qpmpc.identification.identification import identify
    from torch_qpmpc.identification.learned import identify_nonlinear
    from torch_qpmpc.identification.reading import read_log
    from torch_qpmpc.learning.closed_loop import improve
    from torch_qpmpc.learning.gauss_newton import GaussNewton
    from torch_qpmpc.learning.operators import QPActorValueOperator
    from torch_qpmpc.learning.penalties import DeviationPenalty, SystemIdentificationPenalty
    from torch_qpmpc.learning.q_learning import QPQLearningLoss
    from torch_qpmpc.learning.theta_network import ThetaNetwork
    from torch_qpmpc.mpc.bounds import Bounds
    from torch_qpmpc.mpc.cost import Cost
    from torch_qpmpc.mpc.layout import Layout
    from torch_qpmpc.mpc.model import Model
    from torch_qpmpc.mpc.module import QPMPC
    from torch_qpmpc.mpc.nonlinear import RungeKutta
    from torch_qpmpc.mpc.scheme import Scheme
    from torch_qpmpc.qp.pipeline.solve import SolveLog
    from torch_qpmpc.qp.program import QuadraticProgram, Status
    from torch_qpmpc.qp.solve import solve_qp
    from torch_qpmpc.study.runs import load_run

__all__ = [
    "QPMPC",
    "Bounds",
    "CompiledPolicy",
    "Controller",
    "Cost",
    "DeviationPenalty",
    "GaussNewton",
    "Layout",
    "LinearMPC",
    "Model",
    "QPActorValueOperator",
    "QPError",
    "QPQLearningLoss",
    "QuadraticProgram",
    "RungeKutta",
    "Scheme",
    "SolveLog",
    "SolverError",
    "Status",
    "SystemIdentificationPenalty",
    "ThetaNetwork",
    "export_c",
    "export_fmu",
    "identify",
    "identify_nonlinear",
    "improve",
    "load_run",
    "read_log",
    "solve_qp",
]

__version__ = "0.1.0"

if not TYPE_CHECKING:
    #: Imported at first use: Numba, TensorDict and TorchRL take as long to import as torch does.
    _LAZY = {
        "Bounds": "torch_qpmpc.mpc.bounds:Bounds",
        "CompiledPolicy": "torch_qpmpc.export.export:CompiledPolicy",
        "Controller": "torch_qpmpc.control.controller:Controller",
        "Cost": "torch_qpmpc.mpc.cost:Cost",
        "DeviationPenalty": "torch_qpmpc.learning.penalties:DeviationPenalty",
        "GaussNewton": "torch_qpmpc.learning.gauss_newton:GaussNewton",
        "Layout": "torch_qpmpc.mpc.layout:Layout",
        "LinearMPC": "torch_qpmpc.control.linear_mpc:LinearMPC",
        "Model": "torch_qpmpc.mpc.model:Model",
        "QPActorValueOperator": "torch_qpmpc.learning.operators:QPActorValueOperator",
        "QPMPC": "torch_qpmpc.mpc.module:QPMPC",
        "QPQLearningLoss": "torch_qpmpc.learning.q_learning:QPQLearningLoss",
        "QuadraticProgram": "torch_qpmpc.qp.program:QuadraticProgram",
        "RungeKutta": "torch_qpmpc.mpc.nonlinear:RungeKutta",
        "Scheme": "torch_qpmpc.mpc.scheme:Scheme",
        "SolveLog": "torch_qpmpc.qp.pipeline.solve:SolveLog",
        "Status": "torch_qpmpc.qp.program:Status",
        "SystemIdentificationPenalty": "torch_qpmpc.learning.penalties:SystemIdentificationPenalty",
        "ThetaNetwork": "torch_qpmpc.learning.theta_network:ThetaNetwork",
        "envs": "torch_qpmpc.envs:",
        "export_c": "torch_qpmpc.export.export:export_c",
        "export_fmu": "torch_qpmpc.export.fmu:export_fmu",
        "identify": "torch_qpmpc.identification.identification:identify",
        "identify_nonlinear": "torch_qpmpc.identification.learned:identify_nonlinear",
        "improve": "torch_qpmpc.learning.closed_loop:improve",
        "load_run": "torch_qpmpc.study.runs:load_run",
        "read_log": "torch_qpmpc.identification.reading:read_log",
        "solve_qp": "torch_qpmpc.qp.solve:solve_qp",
    }

    def __getattr__(name: str) -> Any:
        if name not in _LAZY:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = pkgutil.resolve_name(_LAZY[name])
        return globals()[name]

    def __dir__() -> list[str]:
        return sorted({*__all__, "envs", "__version__"})


#: Module and length of an episode of each environment.
_ENVIRONMENTS = {"PointMass": ("point_mass", 50), "GrosZanonLTI": ("gros_zanon", 5000)}
for _name, (_module, _steps) in _ENVIRONMENTS.items():
    # Registering an id twice warns, and a reload or a spawned worker imports this again.
    if f"torch_qpmpc/{_name}-v0" not in gymnasium.registry:
        gymnasium.register(
            id=f"torch_qpmpc/{_name}-v0",
            entry_point=f"torch_qpmpc.envs.{_module}:{_name}GymEnv",
            max_episode_steps=_steps,
        )
