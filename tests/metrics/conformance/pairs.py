"""The image pairs that metrics are compared on across libraries: made of integers alone, the same everywhere."""

import hashlib

import numpy as np
import skimage.data


def image_pairs():
    """(render, truth) by name, (H, W, 3) 8-bit: a photo, a head on white, the head's box, an odd small piece."""
    truth = skimage.data.astronaut()
    blurred = (
        sum(np.roll(truth.astype(np.int64), (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)) // 9
    )
    noise = np.random.Generator(np.random.PCG64(7)).integers(-9, 10, truth.shape)
    render = np.clip(blurred + noise, 0, 255).astype(np.uint8)
    y, x = np.mgrid[:512, :512]
    # the face: an ellipse of a tenth of the frame
    inside = ((x - 222) * 130) ** 2 + ((y - 110) * 64) ** 2 <= (64 * 130) ** 2
    on_white = [np.where(inside[..., None], a, 255).astype(np.uint8) for a in (render, truth)]
    rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    odd = np.s_[60:133, 180:281]
    return {
        "photo": (render, truth),
        "head": tuple(on_white),
        "crop": tuple(a[box] for a in on_white),
        "odd": (render[odd], truth[odd]),
    }


def fingerprint(pair):
    """Digest of a pair's pixels."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in pair)).hexdigest()
