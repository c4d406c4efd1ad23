"""Faults to plant into good captures: the code that must find each, and codes that may speak up with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from headbench.datasets.ga.layout import Declaration

from ..tiny_capture import edit_json, edit_npz
from .good_capture import HEIGHT, WIDTH, GoodCapture, read_rgb, write_pixels

Plant = Callable[[GoodCapture], None]


@dataclass(frozen=True)
class Fault:
    """``code`` must be found; beside it only ``companions`` may be."""

    code: str
    plant: Plant
    companions: tuple[str, ...] = ()


REFUSED = ("HB100",)
TRAIN, VAL, TEST = "transforms_train.json", "transforms_val.json", "transforms_test.json"


def _declare(**changes) -> Plant:
    return lambda good: replace(Declaration.read(good.union), **changes).write(good.union)


def _each(change: Callable[[dict], object]) -> Plant:
    return lambda good: good.each_frame(change)


def _edit(file: str, change: Callable[[dict], object]) -> Plant:
    return lambda good: good.edit(file, change)


def _matrix(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict], None]:
    def edit(frame: dict) -> None:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return edit


def _test_images(good: GoodCapture, timestep: int) -> list:
    return sorted(good.writer.sequence_folder("FREE").glob(f"images/{timestep:05d}_*.png"))


# ------------------------------------------------------------------ files


def _cut_json(good):
    path = good.union / VAL
    path.write_text(path.read_text()[:-20])


def _cut_image(good):
    path = _test_images(good, 2)[1]
    path.write_bytes(path.read_bytes()[:-30])


def _freeze(good):
    for source, target in zip(_test_images(good, 3), _test_images(good, 4)):
        target.write_bytes(source.read_bytes())


def _orphan(good):
    path = good.files("images")[0]
    path.with_name("00777_00.png").write_bytes(path.read_bytes())


def _orphan_jpeg(good):
    path = good.files("images")[0]
    cv2.imwrite(str(path.with_suffix(".jpg")), read_rgb(path))


def _small_mask(good):
    write_pixels(good.files("fg_masks")[7], np.full((HEIGHT // 2, WIDTH // 2), 255, np.uint8))


def _one_later(value):
    for frame in value["frames"]:
        frame["timestep_index"] += 1


def _absolute(frame):
    for key in ("file_path", "fg_mask_path", "flame_param_path"):
        frame[key] = "/export/rig7/" + frame[key].lstrip("./")


# ------------------------------------------------------------------ splits


def _copy_to_test(good):
    source = good.files("images")[0]
    _test_images(good, 5)[0].write_bytes(source.read_bytes())


def _nearly_copy_to_test(good):
    image = read_rgb(good.files("images")[0]).astype(int)
    noise = np.random.default_rng(0).integers(-1, 2, size=image.shape)
    write_pixels(_test_images(good, 5)[0], np.clip(image + noise, 0, 255).astype(np.uint8))


def _move(source: str, index: int) -> Plant:
    def plant(good):
        moved = []
        good.edit(source, lambda v: moved.append(v["frames"].pop(index)))
        good.edit(TRAIN, lambda v: v["frames"].append(moved[0]))

    return plant


# ------------------------------------------------------------------ images


def _soil(image, mask):
    spots = (np.random.default_rng(0).random(mask.shape) < 0.1) & (mask == 0)
    return np.where(spots[..., None], 180, image).astype(np.uint8)


def _room(good):
    """Behind the subject, which no mask separates from it."""
    shades = np.linspace(60, 200, HEIGHT)[:, None, None]
    good.each_image(lambda image, mask: np.where(mask[..., None] == 0, shades, image).astype(np.uint8))
    good.without_masks()


def _shoulders(good):
    """The lower part of the pictures is filled by clothes, without their lowest rows and outermost columns."""
    part = np.s_[int(0.7 * HEIGHT) : -3, 3:-3]

    def fill(value):
        def change(image, mask):
            changed = (image if value != 255 else mask).copy()
            changed[part] = value
            return changed

        return change

    good.each_image(fill(255), masks=True)
    good.each_image(fill(90))


def _premultiply_again(image, mask):
    alpha = mask[..., None].astype(float) / 255
    added = image - (1 - alpha) * 255
    return np.clip(np.round(alpha * added + (1 - alpha) * 255), 0, 255).astype(np.uint8)


def _never_multiplied(image, mask):
    """Colours of the subject as they are, wherever the mask is not zero."""
    alpha = mask[..., None].astype(float) / 255
    colour = (image - (1 - alpha) * 255) / np.maximum(alpha, 0.02)
    grounded = 0.4 * np.clip(colour, 0, 255) + (1 - alpha) * 255  # a dark subject, which white cannot swamp
    return np.where(alpha > 0, np.clip(grounded, 0, 255), 255).round().astype(np.uint8)


def _flat_mask(level: int) -> Plant:
    def plant(good):
        for image in _test_images(good, 4):
            write_pixels(
                image.parent.parent / "fg_masks" / image.name, np.full((HEIGHT, WIDTH), level, np.uint8)
            )

    return plant


def _blank(good):
    for path in _test_images(good, 4):
        write_pixels(path, np.full((HEIGHT, WIDTH, 3), 128, np.uint8))


def _images(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Plant:
    return lambda good: good.each_image(change)


def _masks(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Plant:
    return lambda good: good.each_image(change, masks=True)


def _limited(image, mask):
    return np.round(16 + image * (219 / 255)).astype(np.uint8)


def _limited_subject(image, mask):
    """Decoded in limited range, then put on white; the skin is stretched first to reach black and white."""
    alpha = mask[..., None].astype(float) / 255
    colour = (image - (1 - alpha) * 255) / np.maximum(alpha, 0.02)
    stretched = np.clip((colour - 120) * 4, 0, 255)
    return np.round(alpha * (16 + stretched * 219 / 255) + (1 - alpha) * 255).astype(np.uint8)


def _grey(image, mask):
    return np.repeat(image.mean(axis=2, keepdims=True).round().astype(np.uint8), 3, axis=2)


def _tint_one_camera(good):
    for path in good.files("images"):
        if path.stem.endswith("_01"):
            image = read_rgb(path).copy()
            blue = image[..., 2].astype(float)
            image[..., 2] = np.where(image.min(axis=2) < 250, np.clip(blue * 1.6, 0, 255), blue)
            write_pixels(path, image)


def _jpeg(good):
    for path in good.files("images"):
        cv2.imwrite(str(path.with_suffix(".jpg")), read_rgb(path)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        path.unlink()
    good.each_frame(lambda frame: frame.update(file_path=frame["file_path"].replace(".png", ".jpg")))


def _jpeg_as_png(good):
    for path in good.files("images"):
        options = [cv2.IMWRITE_JPEG_QUALITY, 95]
        path.write_bytes(cv2.imencode(".jpg", read_rgb(path)[..., ::-1], options)[1].tobytes())


# ------------------------------------------------------------------ cameras


def _same_camera(good):
    matrices: dict[int, list] = {}
    good.each_frame(lambda f: matrices.setdefault(f["camera_index"], f["transform_matrix"]) and None)
    good.each_frame(lambda f: f.update(transform_matrix=matrices[0]) if f["camera_index"] == 1 else None)


def _matrices(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    return _each(_matrix(change))


def _millimetres(matrix):
    return np.block([[matrix[:3, :3], 1000 * matrix[:3, 3:]], [matrix[3:]]])


def _set_all(**values) -> Plant:
    return _each(lambda frame: frame.update(values))


def _nudge_one_frame(good):
    def nudge(matrix):
        matrix[0, 3] += 0.01
        return matrix

    good.edit(TRAIN, lambda v: _matrix(nudge)(v["frames"][10]))


def _shift_one_camera(good):
    def shift(matrix):
        matrix[:3, 3] += 0.06 * matrix[:3, 0]
        return matrix

    good.each_frame(lambda f: _matrix(shift)(f) if f["camera_index"] == 3 else None)


# ------------------------------------------------------------------ tracking


def _parameters(change: Callable[[dict, int], object]) -> Plant:
    return lambda good: good.each_parameters(change)


def _one(position: int, change: Callable[[dict], None]) -> Plant:
    return lambda good: edit_npz(good.files("flame_param")[position], change)


def _sequence_version(good):
    path = good.writer.sequence_folder("FREE") / "headbench.json"
    edit_json(path, lambda declared: declared.update(head_model="flame2020"))


def _repeat_parameters(good):
    files = sorted(good.writer.sequence_folder("FREE").glob("flame_param/*"))
    files[6].write_bytes(files[5].read_bytes())


def _far_test(good):
    for path in good.writer.sequence_folder("FREE").glob("flame_param/*"):
        edit_npz(path, lambda a: a.update(expr=2.5 * a["expr"]))


def _jump(arrays):
    arrays["translation"][0, 1] += 0.05


def _shrink(good):
    template = good.writer.plan.head.template.astype(np.float32)
    good.each_parameters(lambda a, i: a.update(static_offset=a["static_offset"] - 0.7 * template))


CAPTURES = (
    (
        Fault("HB507", _set_all(cx=2.0), ("HB510", "HB701", "HB702")),
        Fault("HB100", _edit(TRAIN, lambda v: v["frames"][4].update(camera_id="x")), ("HB502",)),
        Fault("HB105", _edit(TRAIN, lambda v: v["frames"].pop(5)), ("HB113",)),
        Fault("HB601", _declare(head_model="flame2020"), ("HB100", "HB613")),
        Fault("HB103", lambda good: good.files("flame_param")[4].write_bytes(b"PK\x03\x04")),
        Fault("HB107", _freeze),
    ),
    (
        Fault("HB108", _declare(excluded={99: "tongue out"}), REFUSED),
        Fault("HB111", _edit(VAL, lambda v: v.update(frames=[])), ("HB113",)),
        Fault("HB502", _same_camera, ("HB702",)),
        Fault("HB114", _edit(TRAIN, lambda v: v["frames"][2].pop("fg_mask_path") and None)),
        Fault("HB201", _copy_to_test, ("HB702",)),
        Fault("HB203", _move(TEST, 4)),
    ),
    (
        Fault("HB205", _edit(TRAIN, lambda v: v["frames"].append(v["frames"][0])), REFUSED),
        Fault(
            "HB608",
            _parameters(lambda a, i: a.update(expr=15 * a["expr"])),
            ("HB701", "HB702", "HB612", "HB615"),
        ),
        Fault("HB109", _declare(excluded={3: " "})),
        Fault("HB113", _orphan),
        Fault("HB202", _nearly_copy_to_test),
        Fault("HB204", _move(VAL, 6)),
    ),
    (
        Fault(
            "HB506",
            _each(lambda f: f.update(fl_x=2 * f["fl_x"], fl_y=2 * f["fl_y"])),
            ("HB100", "HB701", "HB702"),
        ),
        Fault("HB512", _nudge_one_frame, REFUSED),
        Fault("HB110", _declare(excluded={12: "tongue out", 13: "tongue out"})),
        Fault("HB113", _orphan_jpeg),
        Fault("HB301", _declare(background=(0.0, 0.0, 0.0))),
        Fault("HB304", _flat_mask(0)),
    ),
    (
        Fault("HB612", _one(15, _jump), ("HB702",)),
        Fault("HB101", _cut_json),
        Fault("HB102", _edit(TRAIN, lambda v: v["frames"][3].pop("file_path"))),
        Fault("HB103", lambda good: _test_images(good, 2)[1].unlink()),
        Fault("HB104", _small_mask),
        Fault("HB106", _edit(TEST, _one_later), REFUSED),
    ),
    (
        Fault("HB103", _cut_image),
        Fault("HB112", lambda good: (good.union / "headbench.json").unlink()),
        Fault("HB305", _flat_mask(255)),
        Fault("HB308", _blank),
        Fault(
            "HB501",
            _edit(TRAIN, lambda v: _matrix(lambda m: m * np.array([2.0, 2, 2, 1]))(v["frames"][4])),
            REFUSED,
        ),
        Fault("HB503", _matrices(lambda m: m * np.array([1, -1, -1, 1.0]))),
    ),
    (
        Fault("HB116", _each(_absolute), ("HB602",)),
        Fault("HB602", lambda good: (good.union / "head_model.npz").unlink()),
    ),
    (
        Fault("HB302", _images(_soil)),
        Fault("HB403", _images(_grey)),
        Fault("HB406", _jpeg),
        Fault("HB504", _matrices(lambda m: m * np.array([-1, -1, 1, 1.0]))),
        Fault("HB505", _matrices(_millimetres)),
        Fault("HB508", _set_all(cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2)),
    ),
    (
        Fault("HB303", _images(_premultiply_again)),
        Fault("HB401", _images(_limited_subject)),
        Fault("HB404", _images(lambda image, mask: image[..., ::-1])),
        Fault("HB509", _declare(cy="centre")),
        Fault("HB603", _one(5, lambda a: a.update(expr=np.zeros((1, 99)))), REFUSED),
        Fault("HB606", _parameters(lambda a, i: a.update(eyelids=np.full((1, 2), 0.3)))),
    ),
    (
        Fault("HB303", _images(_never_multiplied)),
        Fault("HB406", _jpeg_as_png),
        Fault("HB604", _one(5, lambda a: a["expr"].fill(np.nan)), REFUSED),
        Fault("HB605", _parameters(lambda a, i: a.update(expr=a["expr"][:, :5]))),
        Fault("HB607", _parameters(lambda a, i: a["jaw_pose"].fill(0.0))),
        Fault("HB609", _one(8, lambda a: a["shape"].__iadd__(0.01))),
    ),
    (
        Fault("HB306", _masks(lambda image, mask: 255 - mask)),
        Fault("HB610", _one(8, lambda a: a.update(dynamic_offset=a["static_offset"] * 0 + 1e-3))),
        Fault("HB611", _repeat_parameters),
        Fault("HB613", _sequence_version),
        Fault("HB614", _parameters(lambda a, i: a["expr"].fill(0.0))),
    ),
    (
        Fault("HB307", _masks(lambda image, mask: mask // 255)),
        Fault("HB616", _far_test, ("HB701", "HB702", "HB612", "HB615")),
    ),
    (
        Fault("HB401", _images(_limited)),
        Fault("HB701", _parameters(lambda a, i: a["translation"].__iadd__(0.04))),
    ),
    (Fault("HB402", _images(lambda image, mask: image // 255)),),
    (Fault("HB309", _room, ("HB403",)),),
    (
        Fault("HB405", _tint_one_camera),
        Fault("HB702", _shift_one_camera),
        Fault("HB703", _shrink, ("HB704",)),
    ),
    (Fault("HB704", _shoulders, ("HB701", "HB702")),),
)
"""Faults that are planted together into one capture, as they do not hide one another."""
FAULTS = tuple(fault for planted in CAPTURES for fault in planted)
