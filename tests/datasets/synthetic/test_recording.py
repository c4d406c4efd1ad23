"""Responses of cameras, exposures with motion, masks at hair: each changes what it should and nothing else."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from headbench.datasets.synthetic.performance import CONTROLS, Performed
from headbench.datasets.synthetic.plan import FRONTAL
from headbench.datasets.synthetic.renderer import (
    BALANCE,
    EXPOSURE,
    GAMMA,
    MATTE_METRES,
    draw_response,
    exposed,
    matte,
    outline,
)

METRE = 1000.0  # pixels of a metre


class Kept:
    """A writer that keeps what it is given."""

    def __init__(self, plan):
        self.plan, self.written = plan, {}

    def write_frame(self, sequence, timestep, camera, image, mask):
        self.written[camera] = image, mask


@pytest.fixture
def recorded(plan, renderer):
    """A renderer of the same head with other settings of the recording, posed at a timestep."""

    def recorded(plan=plan, **changes):
        made = copy.copy(renderer)
        settings = replace(plan.settings, **changes)
        made._plan, made._states = replace(plan, settings=settings, writer=Kept(plan.writer.plan)), {}
        made.pose_at("FREE", 0)
        return made

    return recorded


def test_responses_have_the_spreads_stated():
    drawn = [draw_response(1.0, seed, camera) for seed in range(60) for camera in range(16)]
    logs = np.log([each.gains for each in drawn])
    assert logs.std() == pytest.approx(np.hypot(EXPOSURE, BALANCE), rel=0.1)
    assert (logs[:, 0] - logs[:, 2]).std() == pytest.approx(np.sqrt(2.0) * BALANCE, rel=0.1)
    assert np.log([each.exponent for each in drawn]).std() == pytest.approx(GAMMA, rel=0.1)
    none = draw_response(0.0, 3, 5)
    light = np.random.default_rng(0).random((4, 3))
    np.testing.assert_array_equal(none(light), light)


def linear(levels):
    """The light of sRGB levels, 0 to 255, by IEC 61966-2-1."""
    display = levels / 255.0
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def test_a_camera_changes_each_pixel_by_one_curve_per_channel(plan, recorded):
    """Two numbers a channel, fitted to the pictures of a camera, explain the change; masks and background stay."""
    exact, coloured = recorded(), recorded(camera_colour=2.0)
    curves, cameras = {}, [*plan.cameras][::2]
    for camera in cameras:
        (before, mask), (after, same) = exact.render(camera, 1), coloured.render(camera, 1)
        np.testing.assert_array_equal(mask, same)
        np.testing.assert_array_equal(after[mask == 0], before[mask == 0])
        inside = (mask == 255) & (before.max(2) < 190) & (after.max(2) < 190) & (before.min(2) > 20)
        assert inside.sum() > 200
        for channel in range(3):
            x, y = (np.log(linear(each[inside][:, channel].astype(float))) for each in (before, after))
            slope, shift = np.polyfit(x, y, 1)
            assert np.abs(slope * x + shift - y).max() < 0.06  # levels are whole numbers
            curves[camera, channel] = slope, shift
    shifts = np.array([[curves[camera, channel][1] for channel in range(3)] for camera in cameras])
    assert np.ptp(shifts, axis=0).min() > 0.02  # cameras differ


def test_an_exposure_adds_light_where_it_is_covered():
    """A pixel that red covers half of the time, and one that red and blue cover in turn."""
    red, blue = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.5])
    first = np.array([[red, red]]), np.array([[1.0, 1.0]])
    second = np.array([[blue, blue]]), np.array([[0.0, 1.0]])
    rgb, alpha = exposed([first, second])
    np.testing.assert_allclose(alpha, [[0.5, 1.0]])
    np.testing.assert_allclose(rgb[0], [red, 0.5 * (red + blue)])


def test_a_moving_head_is_the_mean_of_its_sub_frames(plan, recorded):
    def curves(time):
        return {name: 0.9 * (time - 1.0) if name == "head_turn" else np.zeros(len(time)) for name in CONTROLS}

    zero = dict.fromkeys(CONTROLS, 0.0)
    turning = Performed("FREE", [zero], {}, 1.0, np.ones(1), curves)
    moving = replace(
        plan,
        performed={"FREE": turning},
        poses={"FREE": (plan.geometry.translation.pose(zero, "900", 0),)},
    )
    sharp, blurred = recorded(moving), recorded(moving, motion_blur=4.0)
    offsets = blurred.sub_frames("FREE", 0)
    assert len(offsets) > 1
    assert offsets.sum() == pytest.approx(0.0)
    blurred.render_frames("FREE", 0, [FRONTAL])
    seed, masks = plan.render_seed("FREE", 0, FRONTAL), []
    for offset in offsets:
        sharp.pose_at("FREE", 0, offset)
        _, mask = sharp.render(FRONTAL, seed)
        masks.append(mask.astype(float))
    _, found = blurred._plan.writer.written[FRONTAL]
    np.testing.assert_allclose(found, np.mean(masks, axis=0), atol=1.0)


def disc(radius, size=120):
    """Coverage of a disc in the middle, and the distance of each pixel from the middle."""
    rows, columns = np.indices((size, size)) - 0.5 * (size - 1)
    distance = np.hypot(rows, columns)
    return np.clip(radius - distance + 0.5, 0.0, 1.0), distance


@pytest.mark.parametrize("level", [0.5, 1.0, 2.0])
def test_a_matte_displaces_the_outline_of_hair(level):
    radius, limit = 40.0, level * MATTE_METRES * METRE
    alpha, distance = disc(radius)
    found = matte(alpha, np.ones(alpha.shape), level, METRE, 3)
    far = np.abs(distance - radius) > limit + 3.0  # and the softness of the matte
    np.testing.assert_array_equal(found[far], alpha[far])
    assert np.abs(found - alpha).sum() > 0.2 * limit * min(level, 1.0) * radius
    assert (found - alpha).max() > 0.3 * min(level, 1.0)  # too wide at places, and too narrow at others
    assert (found - alpha).min() < -0.3 * min(level, 1.0)


def test_masks_err_at_hair_and_not_along_the_skin(plan, recorded):
    erring = recorded(mask_error=1.0)
    (before, mask), (after, found) = recorded().render(FRONTAL, 5), erring.render(FRONTAL, 5)
    changed = mask != found
    assert changed.sum() > 10
    assert (
        np.abs(before[~changed].astype(int) - after[~changed]).max() <= 1
    )  # where the mask changed by less than a level
    hair, skin = (erring._posed[name].vertices for name in ("hair", "skin"))
    shape = erring._subject
    bare = outline(
        plan.cameras[FRONTAL], skin, shape._fine.faces[shape.hair_share[shape._fine.faces].max(1) == 0.0]
    )
    locks = outline(plan.cameras[FRONTAL], hair, erring._fixed["hair"].faces)
    edge = (mask > 0) & (mask < 255)
    assert (edge & bare & ~locks).sum() > 5
    assert not (changed & bare & ~locks).any()
