"""Videos as cameras and phones write them, made with PyAV."""

from fractions import Fraction

import av
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.videos import probe_video, video_frames


def picture(index, width=64, height=48):
    """Dark, with a bright left upper quarter; the number is in the level of the rest."""
    image = np.full((height, width, 3), 40 + 8 * index, np.uint8)
    image[: height // 2, : width // 2] = (230, 60, 60)
    return image


def write(
    path,
    times,
    size=(64, 48),
    matrix=None,
    sound=False,
    codec="libx264",
    pixels="yuv420p",
    hidden=0,
    cover=False,
    coding=(),
    **properties,
):
    """A video of frames at some times in milliseconds, from ``hidden`` of which on an edit list shows it.

    ``matrix`` is the left upper part of its display matrix, ``cover`` puts a cover picture first, ``coding`` are options of the
    encoder, and ``properties`` those of the stream.
    """
    options = {key: properties.pop(key) for key in ("movflags",) if key in properties}
    if hidden:
        options, coding = {"avoid_negative_ts": "disabled"}, {"bf": "0"}
    with av.open(str(path), "w", options=options) as container:
        picture_stream = container.add_stream("mjpeg", rate=25) if cover else None
        stream = container.add_stream(codec, rate=25, options={"crf": "8", **dict(coding)})
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for name, value in properties.items():
            setattr(stream.codec_context, name, value)
        if picture_stream is not None:
            picture_stream.width, picture_stream.height, picture_stream.pix_fmt = 32, 32, "yuvj420p"
            container.mux(picture_stream.encode(av.VideoFrame.from_ndarray(picture(0, 32, 32), "rgb24")))
            container.mux(picture_stream.encode())
        audio = container.add_stream("aac", rate=44100) if sound else None
        if audio is not None:
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            silence.sample_rate, silence.pts = 44100, 0
            container.mux(audio.encode(silence))
        for index, time in enumerate(times):
            image = np.dstack([picture(index % 20, *size), np.full(size[::-1], 90, np.uint8)])
            frame = av.VideoFrame.from_ndarray(image, "rgba") if pixels == "argb" else None
            frame = frame or av.VideoFrame.from_ndarray(np.ascontiguousarray(image[..., :3]), "rgb24")
            frame.pts, frame.time_base = time - hidden, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        if audio is not None:
            container.mux(audio.encode())
    if matrix is not None:
        data = bytearray(path.read_bytes())
        place = data.rindex(b"tkhd") + 4 + 40 if data[data.rindex(b"tkhd") + 4] == 0 else None
        # ISO 14496-12, 8.3.2.
        a, b, c, d = (round(0x10000 * value) for value in matrix)
        numbers = [a, b, 0, c, d, 0, 0, 0, 0x40000000]
        data[place : place + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in numbers)
        path.write_bytes(bytes(data))
    return path


def levels(frames):
    return [int(np.rint((frame[-4, -4].mean() - 40) / 8)) for _, _, frame in frames]


@pytest.mark.parametrize(("name", "options"), [("a.mp4", {"sound": True}), ("a.mkv", {"codec": "mpeg4"})])
def test_all_frames_come_in_order_with_their_times(tmp_path, name, options):
    path = write(tmp_path / name, range(0, 400, 40), **options)
    frames = list(video_frames(path))
    assert levels(frames) == [*range(10)]
    assert [frame.time for frame in frames] == pytest.approx(np.arange(10) * 0.04, abs=1e-3)
    assert probe_video(path)[:2] == (64, 48)
    assert probe_video(path).rate == pytest.approx(25, rel=0.02)


def test_videos_are_sampled_evenly(tmp_path):
    fast = video_frames(write(tmp_path / "fast.mp4", range(0, 400, 20)), rate=25)
    assert levels(fast) == [*range(0, 20, 2)]
    times = [0, 40, 80, 90, 100, 110, 160, 200, 320, 400]
    frames = list(video_frames(write(tmp_path / "a.mp4", times), rate=25))
    assert levels(frames) == [frame.number for frame in frames] == [0, 1, 2, 6, 7, 8, 9]
    assert [frame.time for frame in frames] == pytest.approx(
        np.array([0, 40, 80, 160, 200, 320, 400]) / 1000, abs=2e-3
    )


UPRIGHT = {
    "phone held upright": ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
    "phone upside down": ((-1, 0, 0, -1), lambda image: image[::-1, ::-1]),
    "phone turned the other way": ((0, -1, 1, 0), np.rot90),
    "front camera": ((-1, 0, 0, 1), lambda image: image[:, ::-1]),
    "upside down and mirrored": ((1, 0, 0, -1), lambda image: image[::-1]),
    "transposed": ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
}


@pytest.mark.parametrize("name", UPRIGHT)
def test_turned_and_mirrored_videos_give_upright_frames(tmp_path, name):
    matrix, turn = UPRIGHT[name]
    path = write(tmp_path / "a.mp4", range(0, 400, 40), matrix=matrix)
    frame = next(video_frames(path)).image
    expected = turn(picture(0))
    assert frame.shape == expected.shape
    assert np.abs(frame - expected.astype(float)).mean() < 6
    assert probe_video(path)[:2] == expected.shape[1::-1]


OBLONG = [
    (Fraction(4, 3), None, (85, 48)),
    (Fraction(8, 9), None, (64, 54)),
    (Fraction(4, 3), (0, 1, -1, 0), (48, 85)),
]


@pytest.mark.parametrize(("ratio", "matrix", "size"), [*OBLONG, (Fraction(255, 256), None, (64, 48))])
def test_pixels_become_square(tmp_path, ratio, matrix, size):
    path = write(tmp_path / "a.mp4", range(0, 400, 40), matrix=matrix, sample_aspect_ratio=ratio)
    assert probe_video(path)[:2] == size
    assert next(video_frames(path)).image.shape[1::-1] == size


COLOURS = [
    ("yuv420p", {"colorspace": 1, "color_range": 1}),
    ("yuvj420p", {"colorspace": 6, "color_range": 2}),
    ("yuv444p10le", {"colorspace": 1, "color_range": 1}),
]


@pytest.mark.parametrize(("pixels", "properties"), COLOURS)
def test_matrix_range_and_depth_do_not_change_colours(tmp_path, pixels, properties):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "2"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
        for name, value in properties.items():
            setattr(stream.codec_context, name, value)
        kr, kb = {1: (0.2126, 0.0722), 6: (0.299, 0.114)}[properties["colorspace"]]
        r, g, b = np.array([200, 60, 90]) / 255  # ITU-T H.273, 8.3
        y = kr * r + (1 - kr - kb) * g + kb * b
        values = np.array([y, (b - y) / (2 - 2 * kb), (r - y) / (2 - 2 * kr)])
        full, unit = properties["color_range"] == 2, 4 if "10" in pixels else 1
        scale, offset = ((255, 255, 255), (0, 128, 128)) if full else ((219, 224, 224), (16, 128, 128))
        frame = av.VideoFrame(64, 48, pixels)
        for plane, level in zip(frame.planes, np.rint((values * scale + offset) * unit)):
            kind = np.dtype(np.uint16 if unit > 1 else np.uint8)
            plane.update(np.full(plane.buffer_size // kind.itemsize, level, kind))
        frame.pts = 0
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert np.abs(next(video_frames(path)).image.astype(int) - [200, 60, 90]).max() <= 2


def test_hidden_frames_and_cover_pictures_are_no_frames(tmp_path):
    path = write(tmp_path / "a.mp4", range(0, 400, 40), hidden=160)
    assert levels(video_frames(path)) == [*range(4, 10)]
    assert probe_video(path).frames == 6
    path = write(tmp_path / "a.mkv", range(0, 400, 40), cover=True)
    assert probe_video(path)[:2] == (64, 48)
    assert levels(video_frames(path)) == [*range(10)]


REFUSED = {
    "bwdif": {"coding": {"x264-params": "tff=1:interlaced=1"}.items()},
    "zscale": {"color_trc": 18, "color_primaries": 9, "colorspace": 9},
    "overlay": {"codec": "qtrle", "pixels": "argb"},
    "transparent ones": {"name": "a.webm", "codec": "libvpx-vp9", "pixels": "yuva420p"},
    "a multiple of 90 degrees": {"matrix": (0.7, 0.7, -0.7, 0.7)},
}


@pytest.mark.parametrize("found", REFUSED)
def test_what_is_not_converted_is_refused_with_the_command(tmp_path, found):
    options = {"name": "a.mov", **REFUSED[found]}
    path = write(tmp_path / options.pop("name"), range(0, 400, 40), **options)
    with pytest.raises(InputError, match=found) as refused:
        probe_video(path)
    assert "ffmpeg -i IN" in str(refused.value)


def test_what_is_no_whole_video_is_refused(tmp_path):
    path = write(tmp_path / "a.mp4", range(0, 2400, 40), movflags="faststart")
    cut = path.read_bytes()[: 6 * path.stat().st_size // 10]
    for content, found in (
        (b"", "no frame"),
        (b"text" * 99, "no frame"),
        (cut, r"expected 2.4 s, as the file states, found \S+ s, \d+ frames"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=found):
            list(video_frames(path))
    with pytest.raises(InputError, match="no such file"):
        list(video_frames(tmp_path / "none.mp4"))
