"""Finding participants, sequences, colour files and stills in every layout."""

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.files import write_json
from headbench.datasets.nersemble.recording import participant, participants

from .recordings import SEQUENCES, SUBJECT, Recording, world_cameras, write_recording


def test_unmerged_parts_of_the_first_release_are_found(tmp_path):
    recording = write_recording(tmp_path, release="v1")
    for number, name in enumerate(SEQUENCES, start=1):
        part = recording.root / f"sequence_{name}_part-{number}" / SUBJECT
        part.mkdir(parents=True)
        (recording.root / SUBJECT / name).rename(part / name)
    (recording.root / SUBJECT).rmdir()
    assert sorted(participant(recording.root, SUBJECT).sequences) == sorted(SEQUENCES)


def with_colour(folder, release, matrices):
    """A recording without frames but with a colour calibration."""
    recording = Recording(folder, release)
    recording.write_calibration(world_cameras())
    recording.sequence_folder("FREE").mkdir(parents=True)
    if release == "v2":
        write_json(recording.calibration_file.with_name("color_calibration.json"), matrices)
        return recording
    old = f"{SUBJECT}/annotations/FREE/color_correction"
    folder = recording.root / (old if release == "paper2023" else f"color_correction/{SUBJECT}")
    folder.mkdir(parents=True)
    for serial, matrix in matrices.items():
        np.save(folder / f"{serial}.npy", matrix)
    return recording


@pytest.mark.parametrize("release", ["v2", "v1", "paper2023"])
def test_colour_files_are_found_where_each_release_has_them(release, tmp_path):
    cameras = world_cameras()
    matrix = np.eye(3, 4) + 0.1 if release != "v2" else np.eye(3, 10) + 0.1
    recording = with_colour(tmp_path, release, {camera.id: matrix for camera in cameras})
    corrections = participant(recording.root, SUBJECT).corrections("FREE", [cameras[0].id])
    np.testing.assert_allclose(corrections[cameras[0].id].matrix, matrix)


@pytest.mark.parametrize("release", ["v1", "v2"])
def test_a_colour_calibration_without_a_camera_is_an_error(release, tmp_path):
    cameras = world_cameras()
    recording = with_colour(tmp_path, release, {cameras[0].id: np.eye(3, 4)})
    with pytest.raises(InputError, match=cameras[1].id):
        participant(recording.root, SUBJECT).corrections("FREE", [c.id for c in cameras])


def test_without_colour_files_there_is_no_correction(pristine_recording):
    assert participant(pristine_recording.root, SUBJECT).corrections("FREE", ["222200037"]) == {}


def test_stills_are_no_sequence(recording):
    recording.write_background("222200037", np.zeros((4, 4, 3), np.uint8))
    one = participant(recording.root, SUBJECT)
    assert "BACKGROUND" not in one.sequences
    assert [*one.backgrounds] == ["222200037"]


def test_the_metadata_says_what_to_fetch(recording):
    recording.write_metadata([*SEQUENCES, "HAIR"])
    one = participant(recording.root, SUBJECT)
    assert one.match("EMO-1") == "EMO-1-shout+laugh"
    for name, listed in (("HAIR", True), ("GLASSES", False)):
        with pytest.raises(InputError) as error:
            one.match(name)
        assert (f"metadata_sequences.csv lists {name}" in str(error.value)) == listed


def test_other_folders_and_missing_files_are_refused(recording, tmp_path):
    (tmp_path / "other" / "images").mkdir(parents=True)
    for name in ("nowhere", "other"):
        with pytest.raises(InputError, match=name):
            participants(tmp_path / name)
    with pytest.raises(InputError, match="subject.*902"):
        participant(recording.root, "902")
    recording.calibration_file.unlink()
    with pytest.raises(InputError, match="camera_params.json"):
        participant(recording.root, SUBJECT)
