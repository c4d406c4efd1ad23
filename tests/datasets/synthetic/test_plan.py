import numpy as np
import pytest

from headbench.datasets.synthetic.plan import FRONTAL, SERIALS, cameras

TARGET = np.array([0.01, 0.02, 0.03])


@pytest.mark.parametrize("count", [1, 2, 3, 8, 15, 16])
def test_every_set_has_the_frontal_camera_in_canonical_order(count):
    made = list(cameras(count, 100, 146, TARGET))
    assert len(made) == count
    assert FRONTAL in made
    assert made == [serial for serial in SERIALS if serial in made]


def test_arc_spans_93_by_32_degrees_and_all_look_at_the_head():
    azimuth, elevation = [], []
    for camera in cameras(16, 550, 802, TARGET).values():
        x, y, z = camera.center - TARGET
        azimuth.append(np.degrees(np.arctan2(x, z)))
        elevation.append(np.degrees(np.arctan2(y, np.hypot(x, z))))
        rotation = camera.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=3e-9)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        seen = camera.K @ (rotation @ TARGET + camera.world_to_camera[:3, 3])
        np.testing.assert_allclose(seen[:2] / seen[2], camera.K[:2, 2], atol=1e-5)
        assert (rotation @ [0.0, 1.0, 0.0])[1] < 0  # up in the world is up in the image
    assert np.ptp(azimuth) == pytest.approx(93.0, abs=4)
    assert np.ptp(elevation) == pytest.approx(32.0, abs=1)
    assert len(np.unique(np.round(azimuth, 3))) >= 15


def test_principal_point_is_off_centre_but_near():
    K = cameras(2, 550, 802, TARGET, seed=3)[FRONTAL].K
    offset = K[:2, 2] - [275, 401]
    assert 0 < np.abs(offset).min()
    assert np.abs(offset).max() < 0.01 * 550
