import pytest

from headbench.reports.view.scene import ViewSettings, open_scene

from ...world import small_run


@pytest.fixture(scope="package")
def run(tmp_path_factory):
    """A run of a method that takes views as they are, one that takes a video, and the mean image."""
    return small_run(tmp_path_factory.mktemp("view"), "mean-image", "ga", "gbs")


@pytest.fixture(scope="package")
def scene(run, tmp_path_factory):
    return open_scene(ViewSettings((str(run.root),)), tmp_path_factory.mktemp("kept"))
