"""A small head and a small clip, made once."""

import pytest

from ..datasets.head.toy import toy_head
from .toy_clip import toy_clip


@pytest.fixture(scope="session")
def head():
    return toy_head(16)


@pytest.fixture(scope="session")
def clip(head):
    return toy_clip(head, timesteps=3, cameras=3, width=28, height=36)
