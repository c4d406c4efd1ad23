"""Metrics as somebody outside writes them, one of each kind; nothing imported but headbench's root."""

import numpy as np

from headbench import InputError, Measurement, MetricSpec, UnavailableError


def difference(image, truth):
    for array in (image, truth):
        if array.dtype != np.uint8 or array.ndim != 3 or array.shape != truth.shape:
            raise InputError(
                "metric", "image", "two 8-bit images of one size", f"{array.dtype} {array.shape}"
            )
    return np.abs(image.astype(int) - truth)


class MeanError:
    """Mean absolute error in levels, over a frame, a region, or a batch."""

    def __call__(self, image, truth):
        return float(difference(image, truth).mean())

    def batched(self, pairs):
        for image, truth in pairs:
            yield self(image, truth)

    def in_regions(self, image, truth, masks):
        error = difference(image, truth)
        if any(mask.shape != error.shape[:2] for mask in masks.values()):
            raise InputError("metric", "mask", "the size of the image", "another")
        return {name: float(error[mask].mean()) for name, mask in masks.items() if mask.any()}


def jump(image, truth, other_image, other_truth):
    change = difference(image, other_image).mean() - difference(truth, other_truth).mean()
    difference(image, truth)
    return float(abs(change))


def file_count(avatar, workload):
    return Measurement(float(len(avatar.files())), {"frames": float(len(workload))})


def hours(record):
    if "seconds" not in record:
        raise UnavailableError("The record has no seconds.", "Train again.")
    return Measurement(record["seconds"] / 3600, {})


def face_error(image, truth, face):
    return MeanError().in_regions(image, truth, {"face": face})["face"]


def worst(pairs):
    return max(float(difference(image, truth).mean()) for image, truth in pairs)


ERROR = MetricSpec("mae", "MAE", "levels", False, 2, "outside_metric:MeanError", kind="regional")
JUMP = MetricSpec("jump", "Jump", "levels", False, 2, "outside_metric:jump", kind="temporal")
FACE = MetricSpec("face", "Face", "levels", False, 2, "outside_metric:face_error", kind="face")
WORST = MetricSpec("worst", "Worst", "levels", False, 2, "outside_metric:worst", kind="set")
FILES = MetricSpec(
    "files", "Files", "", False, 0, "outside_metric:file_count", kind="avatar", detail="frames"
)
HOURS = MetricSpec("hours", "Hours", "h", False, 2, "outside_metric:hours", kind="training")
