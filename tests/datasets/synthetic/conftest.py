"""One small plan, planned once: tests render only what they look at."""

from pathlib import Path

import pytest

from headbench.datasets.synthetic.performance import CONTROLS
from headbench.datasets.synthetic.plan import SynthSettings, load_geometry, plan_subject
from headbench.datasets.synthetic.renderer import default_samples
from headbench.datasets.synthetic.subject import RenderedSubject


@pytest.fixture(scope="session")
def geometry():
    return load_geometry("procedural")


@pytest.fixture(scope="session")
def plan(geometry, tmp_path_factory):
    settings = SynthSettings(1, 3, 8, (48, 70), "procedural", 0, 0.0, default_samples(48, 70))
    return plan_subject(Path(tmp_path_factory.mktemp("plan")), 0, geometry, settings)


@pytest.fixture(scope="session")
def subject(plan):
    return RenderedSubject(plan.person, plan.geometry, plan.shape)


@pytest.fixture
def rest():
    return dict.fromkeys(CONTROLS, 0.0)
