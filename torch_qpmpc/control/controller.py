"""`Controller`: a linear MPC with what it needs between two steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torch_qpmpc.checks import check_kind
from torch_qpmpc.control.design import Target
from torch_qpmpc.control.explain import Explanation, explain
from torch_qpmpc.control.exporting import ControllerExport, export_controller, export_controller_fmu
from torch_qpmpc.control.law import Law, Memory, Outcome, Signals
from torch_qpmpc.control.learning import LearningReport, improve, learn
from torch_qpmpc.control.linear_mpc import SAVED, LinearMPC, packed, unpacked
from torch_qpmpc.control.observer import Observer
from torch_qpmpc.control.review import Review, review
from torch_qpmpc.control.simulation import Run, ready, simulate
from torch_qpmpc.control.state_space import Array, by_name, read_table
from torch_qpmpc.errors import QPError
from torch_qpmpc.files import load_file, reading, save_file
from torch_qpmpc.learning.closed_loop import Improvement

#: The kind of file that `Controller.save` writes.
KIND = "Controller"
#: The arguments of a controller besides its MPC, and the parts of its law that a file holds.
SETTINGS = ("noise", "drift", "gain")
PARTS = (*SETTINGS, "observer", "max_plausible")


class Controller:
    """A `LinearMPC` with an observer, a target within bounds, the last input and names.

    In each step a Kalman filter estimates the state x and constant disturbances w from the
    measured outputs; the steady state within the bounds that is nearest to the set-point is the
    target; and the MPC plans with it. So constant disturbances, and errors of the model's gain,
    leave no offset, and a set-point out of reach is tracked as near as the bounds allow.

    Args:
        mpc: the MPC. Call `reset` when its plan's theta has changed.
        noise: standard deviations of the outputs' noise, as a number, a vector or by name; by
            default the identification's, else a tenth of half the distance between the output's
            bounds or, without bounds, of ``1 / sqrt(Q)``.
        drift: standard deviations of each disturbance's change in a step; by default those that
            the log shows, else it moves an output by its identified noise within the horizon, else
            as ``noise``. A larger ratio of drift to noise rejects disturbances faster and passes on
            more noise.
        gain: L ``(n + n_w, n_y)`` of an observer of your own, see `Observer`, or a function of F
            and H that returns it. Another model, noise or drift brings the Kalman filter back.

    Attributes:
        status: the `Outcome` of the last step, SOLVED before the first.
        p, target: the last plan's input ``(n_p,)``, zero before the first, and `Target`, None
            before it: that of its last stage, or of all if `Design.staged`.

    Raises:
        QPError: an argument is invalid, or the model has no filter.

    Example:
        >>> import torch_qpmpc as qm
        >>> model = ([[0.9]], [[0.5]])
        >>> mpc = qm.LinearMPC(model, 10, Q=1.0, dR=0.1, u_bounds=(-1.0, 1.0))
        >>> controller, y = qm.Controller(mpc), [0.0]
        >>> for _ in range(100):  # the plant has another gain, and a load
        ...     u = controller.step(y, r=[1.0])
        ...     y = 0.9 * y[0] + 0.4 * u + 0.1
        >>> print(y.round(3))
        [1.]
        >>> controller.review(r=[7.0]).faults[0].remedy
        'Set y1 to 6, not 7, or widen u_bounds of u1.'
        >>> controller.redesign(u_bounds=(-0.2, 0.2))
        >>> run = controller.simulate(([[0.8]], [[0.6]]), 100, r=[0.5], load=0.1)
        >>> controller.step(y, r=[4.0])
        array([0.2])
        >>> controller.explain().limits[0].signal
        'u1'
    """

    def __init__(
        self, mpc: LinearMPC, *, noise: Any = None, drift: Any = None, gain: Any = None
    ) -> None:
        check_kind("mpc", mpc, LinearMPC, "qm.LinearMPC makes one of a plant's model.")
        self._own = self._law = ready(Law.of(mpc, noise, drift, gain))  # the first, and the last
        self._start(self._law.begun())

    def reset(self, y: Any = None, u: Any = None, known: Any = None) -> None:
        """Forget the past: the plant rests with the outputs ``y`` and ``known`` signals.

        Without y, its state may be any state in the model's log; without a log it rests with the
        next step's outputs. `simulate` and `learn` also start from rest. If the plant moves, pass
        only ``u``, the input that holds it there, by default zero and clipped into the bounds; the
        next move is counted from it. The forms are those of `step`.

        Raises:
            QPError: an argument is invalid.
        """
        self._own = self._law = law = ready(replace(self._own))  # with today's theta
        memory = law.begun(None if u is None else read_table("u", u, law.design.plant.inputs, 1)[0])
        memory = memory._replace(r=self.r)
        y = None if y is None else law.read("y", y, 1)[0]
        if known is not None or y is not None:
            d = law.read_known(known, 1)[0]
            e = None if y is None else law.rested(memory.u, d, y)
            steps = 0 if y is None else len(law.observer.gains) - 1
            memory = memory._replace(known=d, e=e, rest=(y, memory.rest[1]), steps=steps)
        self._start(memory)

    def _start(self, memory: Memory) -> None:
        """Take a memory without a step."""
        self._memory = memory
        self.status = Outcome.SOLVED
        self._now: Signals | None = None
        self.target: Target | None = None
        self.p = torch.zeros(self.mpc.plan.n_p, dtype=torch.float64)

    def __repr__(self) -> str:
        """Return its design and the last input."""
        return f"Controller({self.mpc.design}; u = {self.u.round(4).tolist()})"

    @property
    def mpc(self) -> LinearMPC:
        """The MPC that makes the plans."""
        return self._law.mpc

    @property
    def observer(self) -> Observer:
        """The observer that estimates x and w."""
        return self._law.observer

    @property
    def max_plausible(self) -> tuple[Array, Array]:
        """The largest sizes of outputs and set-points, and of known signals, that are no errors."""
        return self._law.max_plausible

    @property
    def x(self) -> Array:
        """The estimate of the state, zero before the first step."""
        return self._law.estimates(self._memory)[0].copy()

    @property
    def w(self) -> Array:
        """The estimate of the disturbances, zero before the first step."""
        return self._law.estimates(self._memory)[1].copy()

    @property
    def u(self) -> Array:
        """The last input, ``(m,)``."""
        return self._memory.u.copy()

    @property
    def r(self) -> Array:
        """The last valid set-points."""
        return self._memory.r.copy()

    def step(self, y: Any, r: Any = None, known: Any = None) -> Any:
        """Return the input for measured outputs: a vector ``(m,)``, or by name if y is by name.

        No value of a signal raises: the estimates go on, and `status` says what happened.

        Args:
            y: outputs, by name or as a vector ``(n_y,)``; None if all are missing. An output that
                is None, NaN or above `max_plausible` is missing, and its prediction replaces it.
            r: set-points in the same forms, by default the last ones; with a preview also rows for
                the stages 0, .., N; the last one is held.
            known: known signals for the stages 0, .., N, as a DataFrame or a mapping of columns
                with at least N + 1 rows; or one row, which is held.

        Returns:
            The plan's first input; without a plan the last input, within its bounds.

        Raises:
            QPError: a name or shape is wrong, or set-points or known signals are missing.
        """
        law, rows = self._law, self.mpc.horizon + 1
        ahead = law.read_known(known, rows, sane=False)
        set_points = law.read_set_points(r, rows, self._memory.r, sane=False)
        measured = read_table("y", y, law.design.plant.outputs, 1, finite=False)[0]
        self._now = Signals(measured, set_points, ahead)
        move = law.step(self._memory, *self._now)
        self._law, self._memory, self.status = move.law, move.memory, move.status
        self._plan = move.plan
        if move.target is not None and move.p is not None:
            self.p, *target = map(torch.from_numpy, (move.p, *move.target))
            self.target = Target(*target)
        if isinstance(by_name(y), Mapping):
            return dict(zip(law.design.plant.inputs, move.u.tolist(), strict=True))
        return move.u.copy()

    def observe(self, y: Any, u: Any, known: Any = None) -> None:
        """Record a step in manual mode, in which another input than this controller's was applied.

        The estimates follow, and the next `step` moves from that input ``u``: without a bump. The
        last one replaces an entry that is None, NaN or absurd. The outputs ``y`` and one row of
        ``known`` signals have the forms of `step`.

        Raises:
            QPError: a name or shape is wrong, or known signals are missing.
        """
        law, ahead = self._law, self._law.read_known(known, 1, sane=False)
        applied = read_table("u", u, law.design.plant.inputs, 1, finite=False)[0]
        measured = read_table("y", y, law.design.plant.outputs, 1, finite=False)[0]
        self._memory, self.status = law.observed(self._memory, measured, applied, ahead)
        self._now = None

    def redesign(self, **changes: Any) -> None:
        """Change weights, bounds and the filter between two steps; the estimates stay.

        So do the last input, what is not named and, without ``noise`` and ``drift``, the observer.

        ``changes`` are some of the arguments ``Q``, ``R``, ``dR``, ``y_bounds``, ``u_bounds``,
        ``du_bounds``, ``y_slack``, ``u_target``, ``violation``, ``constraints`` and
        ``terminal_constraints`` of `LinearMPC`, ``noise`` and ``drift``. A mapping changes what it
        names; None in it removes it, or asks for the default.

        Raises:
            QPError: an argument is invalid or contradicts a minimum time, or the MPC learns.
        """
        law = self._own.redesigned(**changes)
        law.check_runs(self._memory)
        self._own = self._law = ready(law)
        u = np.clip(self.u, *self.mpc.design.u_bounds)
        self._memory, self._now = self._memory._replace(u=u), None

    def save(self, path: str | Path) -> None:
        """Write this controller, its estimates and its last input to ``path``, without code.

        Raises:
            QPError: a part of theta has a parametrization that is not QPMPC's own.
            OSError: writing failed; the old file is unchanged.
        """
        parts = {name: getattr(self._law, name) for name in PARTS}
        parts["point"] = self._law.design.plant.point
        state = packed(parts | self._memory._asdict())
        save_file(path, KIND, {**self._own.mpc.stored(), "controller": state})

    @classmethod
    def load(cls, path: str | Path) -> Controller:
        """Return the controller that `save` wrote to ``path``; it goes on where that one was.

        Raises:
            QPError: the file is missing or damaged, of another kind or release, or holds more than
                tensors and plain values.
        """
        content = load_file(path, KIND)
        with reading(path, *SAVED):
            return cls._of_stored(content)

    @classmethod
    def _of_stored(cls, content: Mapping[str, Any]) -> Controller:
        state = unpacked(content["controller"])
        parts = {name: state.pop(name) for name in PARTS}
        mpc, settings = LinearMPC.of_stored(content), (parts[x] for x in SETTINGS)
        parts["observer"] = Observer(**parts["observer"])
        controller, own = cls.__new__(cls), Law.of(mpc, *settings)
        law = own if (point := state.pop("point")) is None else own.around(point, aims=True)
        controller._law = law = ready(replace(law, **parts))
        controller._own = law if point is None else own
        controller._start(Memory(**state))
        return controller

    def simulate(self, plant: Any = None, steps: int = 200, r: Any = None, **options: Any) -> Run:
        """Return a closed loop of a copy of this controller with a plant, from rest.

        A model starts as near as it can to rest with the last `reset`'s input and outputs and the
        first known signals; an environment where its own reset says, with estimates as without y.

        Args:
            plant: a model as `LinearMPC` takes it, by default its own; or an environment with
                Gymnasium's ``reset`` and ``step`` whose observations are the outputs.
            steps: the number of steps.
            r: a set-point that is held, or rows of them, by default the last one.
            options: ``known``: a row of known signals that is held, or at least ``steps`` rows, the
                last of which is held at the end; by default the last step's or reset's, and with an
                environment the forecast in its ``info["known"]``, in the forms of `step`. An
                environment must run the same signals. ``u``: the input to start from, by default
                the last reset's, else a nonlinear model's own. ``load``: a constant that is added
                to the inputs. ``noise``: standard deviations of the outputs' noise, as a number, a
                vector or by name. ``x``: the start state of a model. ``seed``: seeds both.

        Raises:
            QPError: an argument is invalid.
            SolverError: no input satisfies the hard bounds in a step.
        """
        return simulate(replace(self._own), self._memory, plant, steps, r, **options)

    def learn(self, source: Any, transitions: int = 5000, **options: Any) -> LearningReport:
        """Identify the model again, and keep the new one if closed loops cost less with it.

        The loops must show that the design's own cost, `Run.costs`, falls by 1 %. Then the
        controller starts again with the new model, from rest with its last input. Loops start where
        the last `reset` rests; with a log's model, at rest in the middle of the set-points; with an
        environment, where its own reset says.

        Args:
            source: an environment, as in `simulate`, for transitions in closed loops whose
                set-points move within the bounds, and further pairs of loops that decide. Or a log
                of its signals, as `read_log` reads it: its first two thirds are fitted, and loops
                with a model of the last third, with its one-step errors as noise, decide.
            transitions: the number to gather from an environment, rounded up to whole loops.
            options: ``r``, the middle of the set-points, by default the last one, or the log's mean
                within the outputs' bounds. ``spread``: their largest distance from it, by default a
                tenth of half the distance of the outputs' bounds, or the log's standard deviation.
                ``known``: as in `simulate`, for an environment. ``steps``: the steps of a loop.
                ``pairs``: the largest number of pairs, at least 16. ``seed``: seeds set-points,
                noise and environment.

        Raises:
            QPError: an argument is invalid, or the transitions determine no model with a steady
                state and a filter.
            SolverError: no input satisfies the hard bounds in a step of this controller.
        """
        law = replace(self._law)
        report, candidate = learn(law, self._memory, source, transitions, **options)
        if report.accepted:
            self._own = self._law = ready(candidate)
            steps = len(self._law.observer.gains) - 1  # from rest
            self._start(self._memory._replace(e=None, P=None, steps=steps))
        return report

    def improve(self, log: Any, r: Any = None, spread: Any = None, **options: Any) -> Improvement:
        """Move the MPC's theta along the gradient of the cost of simulated closed loops.

        It is `torch_qpmpc.improve` for this controller: its observer, target and bounds act in
        loops of a model that is identified from the log, with its noise. `Run.costs` is the cost.
        If held-out loops cost less, and `review` has no new fault, the new theta is kept; estimates
        and last input stay. Half of the loops have constant set-points. Learned q and b are held.

        Args:
            log: a log of its signals, as `read_log` reads it. Loops start at its steps within the
                outputs' bounds and replay its known signals from there.
            r, spread: set-points, as in `learn` for a log.
            options: arguments of `torch_qpmpc.improve`, except ``cost``.

        Raises:
            QPError: an argument is invalid, the log determines no model, or the MPC learns nothing.
        """
        report, law = improve(replace(self._law), self._memory, log, r, spread, **options)
        if report.kept:
            law, before = ready(law), {x.name for x in self.review(r).faults}
            faults = [x for x in review(law, self._memory, r, None).faults if x.name not in before]
            if faults:
                notes = (f"With it, {x.name}: {x.text}." for x in faults)
                return replace(report, kept=False, notes=(*report.notes, *notes))
            self._own, self._law, self._now = law, law, None
        return report

    def review(self, r: Any = None, known: Any = None) -> Review:
        """Return findings about this design: sentences, and a remedy for each fault.

        They cover the cost, the terminal weight, the horizon, the disturbances, hard bounds, the
        reach of set-points ``r``, by default the last step's, and the loop without active bounds
        (its margin, offset and noise). ``known``, a row, is held, by default the last step's or
        reset's, else the means of the model's log, else zero.

        Raises:
            QPError: r or known is invalid.
            SolverError: the bounds of the inputs admit no steady state.
        """
        return review(replace(self._law), self._memory, r, known)

    def explain(self) -> Explanation:
        """Return the last plan, what holds it back, and what is in reach; ``print`` shows it.

        Raises:
            QPError: the last call was no `step`.
        """
        if self._now is None:
            got, want = "no step since the last change", "a step to explain"
            raise QPError.expected("controller", got, want, "Call step first.")
        return explain(self._law, self._memory, self.status, self._now, self._plan)

    def export_c(
        self, folder: str | Path, *, name: str = "policy", **options: Any
    ) -> ControllerExport:
        """Write this controller as C99 without heap or dependencies to ``folder``.

        ``name_step(&state, y, r, known, u)`` of ``name.c`` is `step`, with the estimates, the last
        input and the active sets of all QPs in the state. With a C compiler, a closed loop is
        compared with this controller's.

        The ``options`` are ``dtype`` and ``max_iterations`` of `export_c`, and ``missing``, True
        for a plant whose outputs are often missing: the C code then carries the covariance of the
        n_e estimates, as `step` does, with n_e^2 more numbers of state, tables of twice as many,
        and about 4 n_e^3 operations. Otherwise the steady gains stay. The report has sizes and the
        measured agreement.

        Raises:
            QPError: as in `export_c`, or the self-test fails.
        """
        return export_controller(replace(self._law), self._memory, folder, name, **options)

    def export_fmu(
        self, path: str | Path, *, name: str = "policy", **options: Any
    ) -> ControllerExport:
        """Write this controller as an FMU of FMI 3.0 for co-simulation, with sources and a library.

        With an output T, an input q and a known signal d, its inputs are ``y.T`` (NaN if missing),
        ``r.T`` and ``known.d`` for N + 1 stages, where a NaN holds the stage before; its outputs
        are ``u.q`` and ``status``. While ``manual`` is true, it records ``applied.q`` as `observe`
        does. ``last.q`` is the input before the start, and with ``rests`` it starts as by
        ``reset(y, u, known)``. ``lower.q`` and ``upper.q`` are bounds. A step takes the model's dt,
        or a second. ``name`` is the model's identifier; the options are ``max_iterations`` as in
        `export_c`, whose report it returns for ``path``.

        Raises:
            QPError: no C compiler is installed, or as in `export_c`.
        """
        return export_controller_fmu(replace(self._law), self._memory, path, name, **options)
