"""Settings of all tests."""

import os

import pytest

pytest.register_assert_rewrite("tests.synthetic")

# One thread for linear algebra: two test processes would fight for two cores (measured: 84 s
# against 32 s for the same tests).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
