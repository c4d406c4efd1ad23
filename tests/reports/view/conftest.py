import pytest

from headbench.bench.runner import run as runner
from headbench.bench.runner.config import RunConfig
from headbench.bench.runner.store import RunFolder
from headbench.reports.view.command import ViewSettings
from headbench.reports.view.scene import open_scene

from ...datasets.head.toy import toy_head
from ...datasets.tiny_capture import make_plan, write_tiny_capture
from ...fuzz.samples import SETTINGS


@pytest.fixture(scope="package")
def run(tmp_path_factory):
    """A run of a method that takes views as they are, one that takes a video, and the mean image; three iterations or none."""
    folder = tmp_path_factory.mktemp("view")
    capture = write_tiny_capture(folder / "data", make_plan(head=toy_head(16, version="procedural2020")))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "write_reports", lambda out: [])
        runner.run(
            RunConfig(
                data=str(capture.union),
                out=str(folder / "out"),
                methods=("mean-image", "ga", "gbs"),
                preset="smoke",
                metrics=("psnr",),
                settings={name: SETTINGS[name] for name in ("ga", "gbs")},
            )
        )
    return RunFolder(folder / "out")


@pytest.fixture(scope="package")
def scene(run, tmp_path_factory):
    return open_scene(ViewSettings((str(run.root),)), tmp_path_factory.mktemp("kept"))
