"""Benchmarks against stated baselines: `python -m benchmarks`.

BLAS runs on one thread, here and in the peers: products of 2 x 2 matrices gain nothing from more, and threads that
wait for one another make figures of a shared machine meaningless. It must be set before NumPy is imported.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
