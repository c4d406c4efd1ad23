"""The shared head and clip."""

import pytest

from .. import world


@pytest.fixture(scope="session")
def head():
    return world.clip().head


@pytest.fixture(scope="session")
def clip():
    return world.clip()
