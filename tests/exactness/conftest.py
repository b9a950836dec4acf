"""One thread for the kernels: starting threads for a few dozen particles costs more than it saves."""

import zlib
from collections.abc import Iterator

import numba
import pytest


@pytest.fixture(autouse=True, scope="package")
def single_thread() -> Iterator[None]:
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


@pytest.fixture
def stream(request: pytest.FixtureRequest) -> int:
    """A number of the test's own, for random numbers that no other test uses."""
    return zlib.crc32(request.node.name.encode())
