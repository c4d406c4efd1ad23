"""There and back: a capture recorded raw and prepared again shows the same head in the same pixels."""

import shutil

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.subject import PosedSubject
from headbench.datasets.nersemble.command import prepare_nersemble, record_nersemble
from headbench.datasets.nersemble.re_record import re_record
from headbench.datasets.nersemble.settings import PrepareSettings, RecordSettings

from ..tiny_capture import edit_json, make_plan, projected, rig, write_tiny_capture

SEQUENCES = "EMO-1,SEN-01,FREE"


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    # Even sizes for videos; the rig looks down a little, so that alignment turns the world.
    plan = make_plan(cameras=rig(96, 128, 49.4, 58.6))
    return read_capture(write_tiny_capture(tmp_path_factory.mktemp("capture"), plan).union)


def seen(clip, timestep, camera):
    """(V, 2) pixels of the posed mesh."""
    (vertices,) = PosedSubject(clip.head, clip.shape, clip.static_offset).meshes([clip.poses[timestep]])
    return projected(vertices, clip.cameras[camera])


@pytest.mark.parametrize(("release", "frames"), [("v2", "images"), ("v1", "video"), ("paper2023", "images")])
def test_there_and_back(release, frames, clip, tmp_path):
    re_record(
        clip, tmp_path / "raw", tracking=tmp_path / "tracking", release=release, masks=frames == "images"
    )
    save_head(tmp_path / "head.npz", clip.head)
    findings = prepare_nersemble(
        PrepareSettings(
            root=str(tmp_path / "raw"),
            out=str(tmp_path / "out"),
            subjects=clip.subject,
            sequences=SEQUENCES,
            tracking=str(tmp_path / "tracking"),
            head=str(tmp_path / "head.npz"),
            downscale=1,
        )
    )
    again = read_capture(findings.data[clip.subject]["union"])
    assert again.timesteps("train") == clip.timesteps("train")
    assert [*again.cameras] == [*clip.cameras]
    for key in again.files:
        moved = np.abs(seen(again, key.timestep, key.camera) - seen(clip, key.timestep, key.camera))
        assert moved.max() < 1e-4
        assert key in clip.files
        if frames == "images":
            # The wall is taken out again; noise and JPEG leave a few levels.
            assert np.abs(again.image(key).astype(int) - clip.image(key)).mean() < 12
            outside = clip.mask(key) == 0
            assert np.abs(again.image(key)[outside].astype(int) - 255).mean() < 2


def test_the_command_says_how_to_prepare(clip, tmp_path):
    source = clip.files[clip.splits["train"][0]].image.parents[2] / "UNION3_901"
    findings = record_nersemble(RecordSettings(str(source), str(tmp_path / "raw")))
    assert "--subjects 901" in findings.text
    names = {entry.name for entry in (tmp_path / "raw").iterdir()}
    assert names == {"recording", "tracking", "head_model.npz"}
    assert (tmp_path / "raw" / "recording" / "901" / "sequences" / "BACKGROUND").is_dir()


def test_a_missing_frame_is_named_before_anything_is_written(clip, tmp_path):
    source = clip.files[clip.splits["train"][0]].image.parents[2]
    shutil.copytree(source, tmp_path / "capture")
    union = tmp_path / "capture" / "UNION3_901"
    gone = {}
    edit_json(union / "transforms_train.json", lambda value: gone.update(value["frames"].pop(1)))
    with pytest.raises(InputError, match="no such frame") as caught:
        record_nersemble(RecordSettings(str(union), str(tmp_path / "raw")))
    assert caught.value.file == str(union)
    assert caught.value.key.endswith(f"/{gone['timestep_index']:05d}/{gone['camera_id']}")
    assert not (tmp_path / "raw").exists()
