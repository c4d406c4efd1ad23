"""One small plan, planned once: tests render only what they look at. And convex meshes."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from headbench.datasets.synthetic import renderer as renderer_module
from headbench.datasets.synthetic.capture import synthesize
from headbench.datasets.synthetic.history import over_time
from headbench.datasets.synthetic.performance import CONTROLS
from headbench.datasets.synthetic.plan import SyntheticSettings, load_geometry, plan_subject
from headbench.datasets.synthetic.renderer import CaptureRenderer
from headbench.datasets.synthetic.subject import RenderedSubject

SMALL = {
    "cameras": 2,
    "timesteps": 4,
    "size": (32, 46),
    "samples_per_pixel": 9,
    "workers": 1,
    "performance": "full",
}


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """The smallest capture: its folder, its union and the calls of its progress. Tests leave it as it is."""
    out = tmp_path_factory.mktemp("synthetic") / "capture"
    calls = []
    (union,) = synthesize(out, **SMALL, progress=lambda done, total, note="": calls.append((done, total)))
    return out, union, calls


@pytest.fixture(scope="session")
def geometry():
    return load_geometry("procedural")


@pytest.fixture(scope="session")
def plan(geometry, tmp_path_factory):
    settings = SyntheticSettings(1, 3, 8, (48, 70), "procedural", 0, 0.0, 9)
    return plan_subject(Path(tmp_path_factory.mktemp("plan")), 0, geometry, settings)


@pytest.fixture(scope="session", autouse=True)
def made_once():
    """A rendered subject takes 1.5 s to make and never changes: tests share one of each person."""
    made = {}

    def subject(person, geometry, shape, correctives=0.0):
        key = repr(person), geometry.source, np.asarray(shape).tobytes(), correctives
        if key not in made:
            made[key] = RenderedSubject(person, geometry, shape, correctives)
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(renderer_module, "RenderedSubject", subject)
        yield


@pytest.fixture(scope="session")
def renderer(plan):
    """One renderer that tests share, each of which poses it first."""
    return CaptureRenderer(plan)


@pytest.fixture(scope="session")
def subject(renderer):
    return renderer._subject


@pytest.fixture
def rest():
    return dict.fromkeys(CONTROLS, 0.0)


def settled(controls, person):
    """The state of the skin of a person who has held an expression for a minute."""
    return over_time([controls], 60.0, person)[0]


def hull_faces(points):
    """(F, 3) triangles of the hull of points (n, 3) about the origin, turned outwards."""
    faces = ConvexHull(points).simplices.copy()
    a, b, c = points[faces].transpose(1, 0, 2)
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces
