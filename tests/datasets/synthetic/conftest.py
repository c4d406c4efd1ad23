"""One small take, planned once: tests render only what they look at."""

from pathlib import Path

import pytest

from headbench.datasets.synthetic.likeness import Likeness
from headbench.datasets.synthetic.performance import CONTROLS
from headbench.datasets.synthetic.studio import default_samples
from headbench.datasets.synthetic.take import Settings, load_geometry, plan_take


@pytest.fixture(scope="session")
def geometry():
    return load_geometry("procedural")


@pytest.fixture(scope="session")
def take(geometry, tmp_path_factory):
    settings = Settings(1, 3, 8, (48, 70), "procedural", 0, 0.0, default_samples(48, 70))
    return plan_take(Path(tmp_path_factory.mktemp("take")), 0, geometry, settings)


@pytest.fixture(scope="session")
def likeness(take):
    return Likeness(take.person, take.geometry, take.shape)


@pytest.fixture
def rest():
    return dict.fromkeys(CONTROLS, 0.0)
