"""The tests. Workers side by side are the parallelism: BLAS threads would only get in their way."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
