from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import STAGES, Changes, HeadPose
from headbench.bench.engine.config import default_names
from headbench.bench.registry import discover, resolve

SPECS = [
    p.spec for p in discover("metrics").values() if p.spec and p.spec.implementation.startswith("headbench.")
]
BY_NAME = {spec.name: spec for spec in SPECS}


def test_more_is_better_of_rates_and_mechanisms_alone():
    rising = {s.name for s in SPECS if s.higher_is_better and not s.per_frame}
    alive = {s.name for s in SPECS if s.kind == "mechanism"}
    assert rising == {"fps", "fps_one_thread", "fps_without_head", "throughput", *alive}


def test_a_run_measures_every_cost_unless_told_otherwise():
    assert {"psnr", "ssim", "lpips"} | {s.name for s in SPECS if not s.per_frame} == set(
        default_names("metrics")
    )


def test_details_are_among_those_that_the_measurement_gives(tmp_path):
    class Avatar:
        def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
            return None

        def draw(self, camera, pose, background, done):
            for stage in STAGES:
                done(stage)

        def read_back(self, drawn):
            return None

        def files(self):
            return [tmp_path / "file"]

        shared_files = files

        def splats(self, pose):
            return SimpleNamespace(means=np.zeros((1, 3)))

        def changes(self, pose):
            return Changes(dict.fromkeys(("opacity", "color", "position"), np.zeros(2)), np.zeros(2, bool))

    (tmp_path / "file").write_bytes(b"1")
    zero = np.zeros(3)
    pose = HeadPose("toy", zero, zero, zero, zero, zero, zero)
    for implementation in {BY_NAME[name].implementation for name in ("storage", "fps", "dynamic_splats")}:
        details = resolve(implementation)(Avatar(), [("a", pose), ("b", pose)]).details
        asked = {s.detail for s in SPECS if s.implementation == implementation} - {""}
        assert asked <= set(details)


@pytest.mark.parametrize("spec", SPECS, ids=lambda s: s.name)
def test_the_implementation_is_there(spec):
    assert callable(resolve(spec.implementation))
