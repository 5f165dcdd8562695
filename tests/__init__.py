"""The tests. BLAS uses one thread: parallelism comes from pytest-xdist's workers."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
