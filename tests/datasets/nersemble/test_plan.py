"""Plans: tracking that is cut with the frames, and the head model a capture is declared for."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.head.arrays import read_head, save_head
from headbench.datasets.nersemble.plan import plan_subject

from ..tiny_capture import edit_npz
from .recordings import SEQUENCES, SUBJECT, tracked_arrays, world_cameras

COUNT = SEQUENCES["FREE"]


def free_of(recording, out, **changes):
    plan = plan_subject(recording.settings(out, **changes), SUBJECT)
    return next(job for job in plan.jobs if job.recorded.name == "FREE")


def remove(recording, number, camera=1):
    name = f"cam_{world_cameras()[camera].id}_{number:06d}.jpg"
    for kind in ("images", "alpha_maps"):
        (recording.sequence_folder("FREE") / kind / name).unlink()


@pytest.mark.parametrize(
    ("removed", "every", "rows"),
    [((5,), 1, (0, 1, 2, 3, 4)), ((0, 3), 1, (1, 2, 4, 5)), ((2,), 2, (0, 4)), ((5,), 2, (0, 2, 4))],
)
def test_tracking_of_all_frames_is_cut_with_them(removed, every, rows, recording, tmp_path):
    head = read_head(recording.head)
    for camera, number in enumerate(removed):
        remove(recording, number, camera)
    path = next(recording.tracking.glob("*FREE*/*/*.npz"))
    with np.load(path) as file:
        arrays = dict(file)
    chosen = slice(None, None, every)
    extra = {"eyelids": np.arange(2 * COUNT, dtype=np.float32).reshape(COUNT, 2)}
    rest = {key: arrays[key] for key in ("shape", "static_offset")}
    moving = {k: v for k, v in arrays.items() if k not in rest and v.shape[:1] == (COUNT,)} | extra
    np.savez(path, **{key: value[chosen] for key, value in moving.items()}, **rest)
    if every > 1:  # the other sequence is tracked at every frame
        for other in recording.tracking.glob("*EMO*/*/*.npz"):
            other.unlink()
    job = free_of(recording, tmp_path / "out", cut=True, every=every)
    assert job.recorded.numbers == rows
    expected = tracked_arrays(head, COUNT)
    for key in ("translation", "rotation", "expr"):
        np.testing.assert_array_equal(job.tracked.frames[key], expected[key][[*rows]].astype(np.float32))
    np.testing.assert_array_equal(job.tracked.frames["eyelids"], extra["eyelids"][[*rows]])


def test_tracking_of_neither_all_nor_the_cut_frames_is_refused(recording, tmp_path):
    for number in (4, 5):
        remove(recording, number)
    path = next(recording.tracking.glob("*FREE*/*/*.npz"))
    moving = {key for key, value in np.load(path).items() if value.shape[:1] == (COUNT,)}
    edit_npz(path, lambda arrays: arrays.update({key: arrays[key][:5] for key in moving}))
    with pytest.raises(InputError, match="4 timesteps.*or 6, as before --cut") as error:
        free_of(recording, tmp_path / "out", cut=True)
    assert (error.value.file, error.value.key) == (str(path), "translation")
    assert "without --tracking" in error.value.remedy
    assert not (tmp_path / "out").exists()


def test_unknown_head_models_are_refused(recording, tmp_path):
    def declared(**changes):
        return plan_subject(recording.settings(tmp_path / "out", **changes), SUBJECT).head_model

    for name in ("flame2020", "flame2023", "flame2023_open", "procedural2023"):
        assert declared(head="", head_model=name) == name
    assert declared(head="") == "flame2023"
    save_head(recording.head, replace(read_head(recording.head), version="mine"))
    assert declared() == declared(head_model="mine") == "mine"
    for version in ("flame2020", "flame2023_open"):
        save_head(recording.head, replace(read_head(recording.head), version=version))
        assert declared(head_model=version) == version
        with pytest.raises(InputError, match="say so if the tracking was made with it"):
            declared()
    for wrong in ({"head": "", "head_model": "flame2032"}, {"head_model": "flame2023"}):
        with pytest.raises(InputError, match=wrong["head_model"]) as error:
            declared(**wrong)
        assert error.value.key == "--head-model"
