"""VHAP's tracked parameters: found, checked, split into an export's files."""

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.head.teeth import with_teeth
from headbench.datasets.nersemble.tracking import find_tracked, read_tracked

from ..head.toy import toy_head
from .recordings import tracked_arrays, write_tracked

COUNT = 5


@pytest.fixture
def head():
    return toy_head(16)


def written(path, head, **changes):
    arrays = tracked_arrays(head, COUNT) | changes
    write_tracked(path, {key: value for key, value in arrays.items() if value is not None})
    return path


def test_an_export_keeps_every_vertex_but_for_one_shift(head, tmp_path):
    tracked = read_tracked(written(tmp_path / "t.npz", head), timesteps=COUNT, head=head)
    arrays = tracked_arrays(head, COUNT)
    exported = [tracked.parameters(timestep) for timestep in range(COUNT)]
    moved = np.concatenate([parameters["translation"] for parameters in exported])
    np.testing.assert_allclose(moved.mean(axis=0), 0, atol=1e-7)
    np.testing.assert_allclose(moved + tracked.shift, arrays["translation"], atol=1e-6)
    for key in ("rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr"):
        stacked = np.concatenate([parameters[key] for parameters in exported])
        np.testing.assert_array_equal(stacked, arrays[key].astype(np.float32))
    assert all(value.dtype == np.float32 for value in exported[0].values())
    np.testing.assert_array_equal(exported[3]["static_offset"], arrays["static_offset"].astype(np.float32))
    assert exported[0]["shape"].shape == (head.shape_basis.shape[2],)


def test_the_canonical_file_is_zero_but_for_identity_and_jaw(head, tmp_path):
    changes = {"dynamic_offset": np.ones((COUNT, len(head.template), 3))}
    tracked = read_tracked(written(tmp_path / "t.npz", head, **changes), timesteps=COUNT)
    assert "dynamic_offset" in tracked.parameters(0)
    canonical = tracked.canonical()
    assert "dynamic_offset" not in canonical
    np.testing.assert_array_equal(canonical["jaw_pose"], [[0.3, 0, 0]])
    assert canonical["jaw_pose"].dtype == np.float64
    zero = {key for key, value in canonical.items() if not value.any()}
    assert zero == {"translation", "rotation", "neck_pose", "eyes_pose", "expr"}


def test_without_a_static_offset_zeros_are_written(head, tmp_path):
    path = written(tmp_path / "t.npz", head, static_offset=None)
    tracked = read_tracked(path, timesteps=COUNT, head=head)
    assert tracked.constant["static_offset"].shape == (1, len(with_teeth(head).template), 3)
    assert not tracked.constant["static_offset"].any()
    with pytest.raises(InputError) as error:
        read_tracked(path, timesteps=COUNT)
    assert error.value.key == "static_offset"


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"expr": None}, "expr"),
        ({"expr": np.zeros((COUNT, 100))}, "expr"),
        ({"shape": np.zeros(300)}, "shape"),
        ({"rotation": np.zeros((COUNT, 4))}, "rotation"),
        ({"eyes_pose": np.zeros((COUNT, 3))}, "eyes_pose"),
        ({"translation": np.full((COUNT, 3), np.nan)}, "translation"),
        ({"translation": np.zeros((COUNT + 1, 3))}, "translation"),
        ({"static_offset": np.zeros((1, 7, 3))}, "static_offset"),
        ({"rotation_matrices": np.zeros((COUNT, 3, 3))}, "rotation_matrices"),
    ],
)
def test_parameters_that_do_not_fit_are_named(changes, key, head, tmp_path):
    path = written(tmp_path / "t.npz", head, **changes)
    with pytest.raises(InputError) as error:
        read_tracked(path, timesteps=COUNT, head=head)
    assert (error.value.file, error.value.key) == (str(path), key)


def place(root, name):
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def test_the_last_epoch_of_the_latest_run_is_found(tmp_path):
    folder = "901_EMO-1_v16_DS4_wBg_staticOffset"
    for run, epochs in (("2026-01-01_10-00-00", (30, 200)), ("2026-01-02_09-00-00", (9, 30))):
        for epoch in epochs:
            place(tmp_path, f"{folder}/{run}/tracked_flame_params_{epoch}.npz")
    place(tmp_path, f"{folder}/2026-01-02_09-00-00/tracked_flame_params_best.npz")
    place(tmp_path, "901_EMO-10_v16/tracked_flame_params_1.npz")
    place(tmp_path, "902_EMO-1_v16/tracked_flame_params_1.npz")
    found = find_tracked(tmp_path, "901", "EMO-1-shout+laugh")
    assert found == tmp_path / folder / "2026-01-02_09-00-00" / "tracked_flame_params_30.npz"
    assert find_tracked(tmp_path, "901", "FREE") is None
    assert find_tracked(tmp_path / "nowhere", "901", "FREE") is None


def test_two_trackings_of_one_sequence_are_an_error(tmp_path):
    place(tmp_path, "901_FREE_v16_DS4/tracked_flame_params_30.npz")
    place(tmp_path, "901_FREE_v16_DS2/tracked_flame_params_30.npz")
    with pytest.raises(InputError, match="901_FREE_v16_DS2, 901_FREE_v16_DS4"):
        find_tracked(tmp_path, "901", "FREE")
