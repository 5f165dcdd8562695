import importlib
import io
import sys

import numba
import numpy as np

from tests.problems import normal
from torch_qpmpc.qp.kernels import linalg
from torch_qpmpc.qp.kernels.linalg import products

#: The spans of more than one matrix.
NONE = np.zeros((0, 2), np.int64)


def test_the_cache_is_renewed_when_a_called_kernel_changes(tmp_path, monkeypatch):
    compiled = "from torch_qpmpc.qp.kernels.linalg import compiled\n{}\n\n@compiled\ndef {}"
    called, caller = (tmp_path / f"{name}_kernel.py" for name in ("called", "caller"))
    caller.write_text(
        compiled.format("from called_kernel import f", "g(x):\n    return f(x) + 1.0\n")
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # which has times in whole seconds
    found = []
    for factor in (2.0, 2.0, 3.0):
        text = compiled.format("", f"f(x):\n    return {factor} * x\n")
        if not found or called.read_text() != text:  # its time counts with older Numba
            called.write_text(text)
        for path in (called, caller):
            monkeypatch.delitem(sys.modules, path.stem, raising=False)
        importlib.invalidate_caches()
        g = importlib.import_module(caller.stem).g
        found.append((g(1.0), g.stats.cache_hits.total()))
    assert found == [(3.0, 0), (3.0, 1), (4.0, 0)]


def test_without_a_writable_cache_kernels_are_compiled_each_time(monkeypatch):
    njit = numba.njit

    def refuses(*arguments, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*arguments, **options)

    monkeypatch.setattr(numba, "njit", refuses)

    @linalg.compiled
    def twice(x):
        return 2 * x

    assert twice(3.0) == 6.0


def test_held_arrays_are_those_of_the_caller_until_it_lets_go():
    @numba.njit
    def add_one(held):
        (x, y), _ = held.parts
        x += 1.0
        return x.sum() + y

    x = np.zeros(3)
    free = sys.getrefcount(x)
    held = linalg.held(((x, 2.0), np.ones(2)))
    assert sys.getrefcount(x) > free
    assert (add_one(held), add_one(held)) == (5.0, 8.0)
    np.testing.assert_array_equal(x, 2.0)
    del held
    assert sys.getrefcount(x) == free


def test_more_than_one_thread_would_take_is_multiplied_in_parts():
    matrix, vectors = normal(1, 300, 400).numpy(), normal(5, 400, seed=1).numpy()
    assert matrix.size > linalg.ONE_THREAD // 5
    found = products(matrix, np.zeros(5, np.int64), vectors, NONE)
    np.testing.assert_allclose(found, vectors @ matrix[0].T, atol=1e-11)


# For each theta


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_first_compilation_is_shown_on_a_terminal(monkeypatch):
    def own(x):
        return x + 1

    def other(x):
        return x + 2

    own.__module__ = "torch_qpmpc.qp.kernels"
    shown = []
    for function in (own, other):
        kernel = numba.njit(function)
        terminal = Terminal()
        monkeypatch.setattr(sys, "stderr", terminal)
        assert kernel(1) == function(1)
        shown.append(terminal.getvalue())
        assert kernel(2) == function(2)
        assert terminal.getvalue() == shown[-1], "nothing is compiled twice"
    assert "compiling for this processor, once" in shown[0]
    assert "own" in shown[0]
    assert not shown[1], "a user's own function is not ours to announce"
