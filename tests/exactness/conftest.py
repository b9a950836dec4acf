"""Random numbers that no two tests share."""

import zlib

import pytest


@pytest.fixture
def stream(request: pytest.FixtureRequest) -> int:
    """A number of the test's own, to seed its generators with."""
    return zlib.crc32(request.node.nodeid.encode())
