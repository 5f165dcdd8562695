"""`CompiledPolicy`: the exported C of a policy, loaded into Python."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_qpmpc.checks import check_kind, check_tensor
from torch_qpmpc.errors import QPError, SolverError
from torch_qpmpc.export.export import build
from torch_qpmpc.export.library import Steps, required_compiler
from torch_qpmpc.mpc.module import QPMPC

#: The causes of the codes.
CODES = ("solved", "not certified within max_iterations", "infeasible", "invalid p")


class CompiledPolicy:
    """The policy and value of a QPMPC in compiled C, for fast closed loops.

    It holds the theta of its creation. Each row of a batch is a controller that starts from its own
    last active set, so that a closed loop of B plants passes ``(B, n_p)`` at each step.

    Args:
        mpc: the QPMPC; its ``on_failure`` is that of the policy: ``"raise"`` raises on a step that
            is not solved, and others return the action that C writes.
        options: ``dtype``, ``storage`` and ``max_iterations``, as in `QPMPC.export_c`.

    Attributes:
        export: sizes and measured agreement, an `Export`.
        last: the results of the last step: actions, codes, values and their error bounds.

    Raises:
        QPError: no C compiler is installed, or as in `QPMPC.export_c`.

    Example:
        >>> import torch, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.of(2, 1, 3, stage_weight=[1.0, 1.0, 0.1], action_bounds=([-1.0], [1.0]))
        >>> policy = qm.CompiledPolicy(mpc)
        >>> s = torch.tensor([[1.0, 0.0], [-0.5, 0.3]])
        >>> torch.allclose(policy(s), mpc.policy(s))
        True
    """

    def __init__(self, mpc: QPMPC, **options: Any) -> None:
        check_kind("mpc", mpc, QPMPC)
        chosen = {"dtype": "float64", "max_iterations": None, "storage": "fast"}
        if unknown := options.keys() - chosen.keys():
            raise QPError.expected(
                "options", ", ".join(sorted(unknown)), f"some of {', '.join(chosen)}"
            )
        chosen |= options
        required_compiler()
        with tempfile.TemporaryDirectory() as folder:
            self.export, library = build(mpc, Path(folder), name="policy", **chosen)
        assert library is not None
        self._library = library
        self._n_p, self._n_u, self._raises = mpc.n_p, mpc.n_u, mpc.on_failure == "raise"
        self._states, self._count = library.states(1), 1
        self.last: Steps | None = None

    def __call__(self, s: Tensor) -> Tensor:
        """Return pi(s): s ``(*batch, n_p)`` to ``(*batch, n_u)``.

        Raises:
            QPError: the shape or type of s is wrong.
            SolverError: with ``on_failure="raise"``, a step is not solved.
        """
        check_tensor("s", s, self._n_p)
        p = s.detach().double().cpu().numpy().reshape(-1, self._n_p)
        if len(p) != self._count:
            self._states, self._count = self._library.states(len(p)), len(p)
        self.last = self._library.steps(self._states, p, self._n_u)
        if self._raises and self.last.codes.any():
            codes = np.bincount(self.last.codes, minlength=len(CODES))
            failures = [f"{codes[i]} {CODES[i]}" for i in range(1, len(CODES)) if codes[i]]
            total = f"{(self.last.codes != 0).sum()} of {len(p)}"
            raise SolverError(f"{total} steps have no certified solution: {', '.join(failures)}.")
        u = torch.from_numpy(self.last.u).to(s)
        return u.reshape(*s.shape[:-1], self._n_u)

    def value(self, s: Tensor) -> Tensor:
        """Return V(s), a cost to go: s ``(*batch, n_p)`` to ``(*batch,)``; errors as in a call.

        It is inf where a step is not solved, as that of the module.
        """
        self(s)
        assert self.last is not None
        value = np.where(self.last.codes == 0, self.last.value, np.inf)
        return torch.from_numpy(value).to(s).reshape(s.shape[:-1])

    def reset(self) -> None:
        """Forget the last active sets."""
        self._states = self._library.states(self._count)
