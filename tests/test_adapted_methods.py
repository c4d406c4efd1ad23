"""Forms that methods declare, from a capture on disk to rows: what must not change does not."""

import dataclasses
import sys
from types import ModuleType

import pytest

from headbench.bench.specs import ResolutionRule
from headbench.methods.trivial.spec import MEAN_IMAGE

from .datasets.tiny_capture import write_tiny_capture
from .world import rows_of, run_on

SQUARE = ResolutionRule(square="pad", size=(128, 128))
FORMS = {
    "VIDEO": {"name": "video", "monocular": True},
    "SQUARE": {"name": "square", "resolution": SQUARE},
    "BOTH": {"name": "both", "monocular": True, "resolution": SQUARE},
}


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Rows of a comparison of the mean image with itself in other forms."""
    folder = tmp_path_factory.mktemp("forms")
    capture = write_tiny_capture(folder / "data")
    module = ModuleType("forms_of_the_mean")
    for name, form in FORMS.items():
        setattr(module, name, dataclasses.replace(MEAN_IMAGE, **form))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, module.__name__, module)
        forms = (f"{module.__name__}:{name}" for name in FORMS)
        run = run_on(capture.union, folder / "out", "mean-image", *forms)
    return rows_of(run)


def values(rows, method):
    chosen = rows[rows["method"] == method].sort_values(["task", "sequence", "timestep", "camera"])
    assert (chosen["status"] == "ok").all()
    return chosen.reset_index(drop=True)


def test_the_mean_of_a_video_is_the_mean_of_its_views(rows):
    """To the bit but for the order of summation, and under the keys of the protocol."""
    plain, video = values(rows, "mean-image"), values(rows, "video")
    keys = ["task", "sequence", "timestep", "camera", "protocol"]
    assert video[keys].equals(plain[keys])
    assert video["value"].to_numpy() == pytest.approx(plain["value"].to_numpy(), abs=1e-3)


@pytest.mark.parametrize("name", ["square", "both"])
def test_a_detour_over_another_size_costs_little(rows, name):
    plain, detour = values(rows, "mean-image"), values(rows, name)
    assert detour["protocol"].equals(plain["protocol"])
    assert abs(detour["value"] - plain["value"]).max() < 0.5  # dB: softened, not shifted
