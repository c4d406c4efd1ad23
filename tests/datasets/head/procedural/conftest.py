"""The default head in both versions."""

import pytest

from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.procedural.surface import load_sculpture


@pytest.fixture(scope="session")
def heads():
    return {version: procedural_head(version) for version in ("procedural2020", "procedural2023")}


@pytest.fixture(scope="session")
def head(heads):
    return heads["procedural2023"]


@pytest.fixture(scope="session")
def surface():
    return load_sculpture()
