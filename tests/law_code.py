"""Actions of an explicit law's C code at many states."""

from __future__ import annotations

import ctypes
import tempfile

import numpy as np

from torch_qpmpc.export.library import FLAGS, compiled
from torch_qpmpc.proofs import SearchTree

WRAPPER = """
#include "law.h"
void actions(const law_real *s, law_real *u, int *codes, long count)
{
    long i;
    for (i = 0; i < count; i++) codes[i] = law_action(s + i * LAW_N_S, u + i * LAW_N_U);
}
"""


def actions(tree: SearchTree, s: np.ndarray, dtype: str) -> tuple[np.ndarray, np.ndarray]:
    """Export and compile a tree, and return u ``(count, n_u)`` and the codes at s."""
    with tempfile.TemporaryDirectory() as folder:
        files = tree.export_c(folder, name="law", dtype=dtype)
        texts = {file.name: file.read_text(encoding="utf-8") for file in files}
    library = compiled(texts | {"wrapper.c": WRAPPER}, [*FLAGS, "-Wall", "-Wextra", "-Werror"])
    s = np.ascontiguousarray(s, dtype)
    u, codes = np.empty((len(s), tree.laws.shape[1]), dtype), np.empty(len(s), np.int32)
    pointers = (ctypes.c_void_p(x.ctypes.data) for x in (s, u, codes))
    library.actions(*pointers, ctypes.c_long(len(s)))
    return u, codes
