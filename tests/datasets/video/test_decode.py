"""Videos as cameras and phones write them, made with PyAV."""

from fractions import Fraction

import av
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.video.decode import probe_video, video_frames


def picture(index, width=64, height=48):
    """Dark, with a bright left upper quarter; the number is in the level of the rest."""
    image = np.full((height, width, 3), 40 + 8 * index, np.uint8)
    image[: height // 2, : width // 2] = (230, 60, 60)
    return image


def write(path, times, size=(64, 48), turned=False, sound=False, codec="libx264", **options):
    """A video of frames at some times in milliseconds; ``turned``: with the flag of a phone that is held upright."""
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=25, options={"crf": "8"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        audio = container.add_stream("aac", rate=44100) if sound else None
        if audio is not None:
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            silence.sample_rate, silence.pts = 44100, 0
            container.mux(audio.encode(silence))
        for index, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(picture(index % 20, *size), "rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        if audio is not None:
            container.mux(audio.encode())
    if turned:
        data = bytearray(path.read_bytes())
        place = data.rindex(b"tkhd") + 4 + 40 if data[data.rindex(b"tkhd") + 4] == 0 else None
        # The display matrix of a quarter turn: (0, 1, 0, -1, 0, 0, 0, 0, 1), ISO 14496-12, 8.3.2.
        matrix = [0, 0x10000, 0, -0x10000, 0, 0, 0, 0, 0x40000000]
        data[place : place + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in matrix)
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


def test_a_turned_phone_gives_upright_frames(tmp_path):
    path = write(tmp_path / "a.mp4", range(0, 400, 40), turned=True)
    frame = next(iter(video_frames(path))).image
    assert frame.shape == (64, 48, 3)
    bright = frame[..., 0].astype(float) > 150
    assert bright[:32, 24:].mean() > 0.9  # the left upper quarter, turned clockwise
    assert bright[32:].mean() < 0.1
    assert probe_video(path)[:2] == (48, 64)


def test_what_is_no_whole_video_is_refused(tmp_path):
    path = write(tmp_path / "a.mp4", range(0, 2400, 40), movflags="faststart")
    cut = path.read_bytes()[: 6 * path.stat().st_size // 10]
    for content, found in ((b"", "no frame"), (b"text" * 99, "no frame"), (cut, "60 frames")):
        path.write_bytes(content)
        with pytest.raises(InputError, match=found):
            list(video_frames(path))
    with pytest.raises(InputError, match="no such file"):
        list(video_frames(tmp_path / "none.mp4"))
