"""Two folders of images or videos: pairs by name, values of the metrics, and errors that name the file."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from headbench.bench import cli
from headbench.bench.audit import folders as module
from headbench.bench.audit.folders import _Video
from headbench.bench.io.images import read_png, write_browser_video, write_png
from headbench.bench.io.videos import video_frames
from headbench.bench.protocol import NamedProtocol, TaskFrames
from headbench.metrics.psnr import psnr

RNG = np.random.default_rng(0)
NAMES = ("a/2", "a/10", "b/1")
TURNED = Image.Exif()
TURNED[0x0112] = 3
INSIDE = np.zeros((24, 32), np.uint8)
INSIDE[4:20, 6:22] = 255


def picture(height=24, width=32):
    return RNG.integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Renders, ground truth and masks of three images in two folders, and a working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "conformance")
    monkeypatch.syspath_prepend(Path(__file__).parents[1])
    for name in NAMES:
        write_png(tmp_path / f"renders/{name}.png", picture())
        write_png(tmp_path / f"truth/{name}.png", picture())
        mask = tmp_path / f"masks/{name}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(INSIDE).save(mask)
    return tmp_path


def evaluated(capsys, *words):
    """Result of the command with ``--json``, and the rows of its CSV file."""
    assert cli.main(["evaluate", *words, "--out", "out.csv", "--json"]) == 0
    with open("out.csv", newline="") as stream:
        return json.loads(capsys.readouterr().out), list(csv.DictReader(stream))


def test_pairs_have_the_values_of_the_metrics(folders, capsys):
    metrics = "psnr,outside_metric:JUMP,outside_metric:FACE,outside_metric:WORST,toy_plugin:NOT_HERE"
    data, rows = evaluated(capsys, "renders", "--truth", "truth", "--masks", "masks", "--metrics", metrics)
    pairs = [
        [read_png(folders / folder / f"{name}.png") for folder in ("renders", "truth")] for name in NAMES
    ]
    expected = [psnr(*pair) for pair in pairs]
    assert [row["name"] for row in rows] == list(NAMES)
    assert [float(row["psnr"]) for row in rows] == expected
    inside = INSIDE > 0
    assert [float(row["psnr/mask"]) for row in rows] == [psnr(*(x[inside][None] for x in p)) for p in pairs]
    faces = [np.abs(np.subtract(*(x[inside].astype(int) for x in p))).mean() for p in pairs]
    assert [float(row["face"]) for row in rows] == faces
    assert rows[0]["jump"] == rows[1]["jump"] != rows[2]["jump"] == ""  # neighbours in the folder alone
    worst = max(np.abs(np.subtract(*(x.astype(int) for x in pair))).mean() for pair in pairs)
    assert {float(row["worst"]) for row in rows} == {worst}
    assert data["mean_of_pairs"]["worst"] == pytest.approx(worst)
    assert data["mean_of_sequences"]["worst"] is None  # of all pairs together
    assert rows[0]["not_here"] == ""
    assert "not" in rows[0]["missing"]
    assert data["mean_of_pairs"]["psnr"] == pytest.approx(np.mean(expected))
    assert data["mean_of_sequences"]["psnr"] == pytest.approx((np.mean(expected[:2]) + expected[2]) / 2)
    assert data["mean_of_pairs"]["not_here"] is None


def test_the_table_has_means_and_says_what_is_missing(folders, capsys):
    for name in NAMES:
        Path(f"renders/{name}.png").rename(f"renders/{name}.jpg")
        Path(f"renders/{name}.jpg").write_bytes(cv2.imencode(".jpg", picture())[1].tobytes())
    words = [
        "renders",
        "--truth",
        "truth",
        "--metrics",
        "l1,ssim@skimage,toy_plugin:NOT_HERE,toy_plugin:NOT_THERE",
    ]
    assert cli.main(["evaluate", *words]) == 0
    text = capsys.readouterr().out
    for part in (
        "L1 ↓",
        "SSIM (skimage) ↑",
        "mean of 2 sequences",
        "mean of pairs",
        "(Absent, Lacking, 3 of 3 pairs)",
    ):
        assert part in text
    assert "3 renders as JPEG or video" in text


def test_the_exit_code_tells_that_nothing_was_scored(folders, capsys):
    words = ["evaluate", "renders", "--truth", "truth", "--metrics", "toy_plugin:NOT_HERE"]
    assert cli.main(words) == 3
    assert "3 of 3 pairs" in capsys.readouterr().out


@pytest.mark.parametrize("method", ["area", "bicubic"])
def test_renders_are_resized_to_the_truth(folders, capsys, method):
    large = picture(48, 64)
    write_png(Path("renders/b/1.png"), large)
    _, rows = evaluated(capsys, "renders", "--truth", "truth", "--metrics", "l1", "--resize", method)
    means = large.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    expected = np.abs(means - read_png(Path("truth/b/1.png"))).mean() / 255
    assert float(rows[2]["l1"]) == pytest.approx(expected, abs=1e-3 if method == "area" else 3e-2)
    if method == "bicubic":
        assert float(rows[2]["l1"]) != pytest.approx(expected, abs=1e-3)


def test_a_protocol_chooses_metrics_and_batches(folders, capsys, monkeypatch):
    protocol = NamedProtocol(
        "x", "", {"self_reenactment": TaskFrames()}, profile="piq", metrics=("psnr@piq",)
    )
    protocol = replace(protocol, pooled=2, size="64x48", crop="none")
    monkeypatch.setattr(module, "protocol_named", {"p": protocol}.__getitem__)
    words = ["evaluate", "renders", "--truth", "truth", "--protocol", "p", "--out", "out.csv"]
    assert cli.main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Protocol p: x. Pixels: 32x24; in the protocol: 64x48. Crop, which is not done here: none." in text
    data, rows = evaluated(capsys, *words[1:-2])
    errors = [10 ** (-float(row["psnr@piq"]) / 10) for row in rows]
    batches = [-10 * np.log10(np.mean(errors[:2])), -10 * np.log10(errors[2])]
    assert data["mean_of_pairs"]["psnr@piq"] == pytest.approx(np.mean(batches))


def test_psnr_of_a_single_folder_is_that_of_the_protocol(folders, capsys):
    """Its errors are averaged before the logarithm, as for pairs of several folders."""
    for level in (16, 1):
        write_png(folders / f"black/{level}.png", np.zeros((24, 32, 3), np.uint8))
        write_png(folders / f"grey/{level}.png", np.full((24, 32, 3), level, np.uint8))
    words = ["evaluate", "black", "--truth", "grey", "--protocol", "vfhq-self"]
    assert cli.main([*words, "--metrics", "psnr"]) == 0
    pooled = -10 * np.log10((16**2 + 1) / 2 / 255**2)
    assert f" {pooled:.2f}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["vfhq-cross", "--metrics", "psnr"], "--metrics: expected CSIM or AED or APD or AKD.*found psnr"),
        (["suite", "vfhq-self"], "--protocol: expected one protocol with --truth, found suite, vfhq-self"),
    ],
)
def test_a_protocol_refuses_what_it_cannot_have(folders, capsys, words, message):
    assert cli.main(["evaluate", "renders", "--truth", "truth", "--protocol", *words]) == 2
    assert re.search(message, " ".join(capsys.readouterr().err.split()))


FAULTS = {
    "a render without truth": (lambda: Path("truth/a/2.png").unlink(), "truth: .*each of the 3 in renders.*a/2"),
    "a truth without render": (lambda: Path("renders/b/1.png").unlink(), "renders: .*the 3 in truth.*b/1"),
    "no mask": (lambda: Path("masks/b/1.png").unlink(), "masks: .*b/1"),
    "no images": (lambda: [p.unlink() for p in Path("truth").glob("*/*")], "truth: .*images or videos.*none"),
    "no folder": (lambda: Path("truth").rename("other"), "truth: .*no such file or folder"),
    "another size": (
        lambda: write_png(Path("renders/a/2.png"), picture(48, 64)),
        r"renders/a/2.png, size: .*32x24 pixels, as truth/a/2.png, found 64x48.*--resize",
    ),
    "another ratio": (lambda: write_png(Path("renders/a/2.png"), picture(24, 24)), "renders/a/2.png, size"),
    "another size of a mask": (lambda: write_png(Path("masks/a/2.png"), picture(9, 9)), "masks/a/2.png, size"),
    "a mask of 0 and 1": (
        lambda: Image.fromarray(INSIDE // 255).save("masks/a/2.png"),
        "masks/a/2.png: .*levels up to 1",
    ),
    "two of a name": (lambda: write_png(Path("renders/a/2.jpeg"), picture()), "2.*: expected one file of this name"),
    "transparency": (
        lambda: Image.fromarray(np.full((24, 32, 4), 90, np.uint8)).save("renders/a/2.png"),
        "renders/a/2.png, alpha: .*transparent",
    ),
    "an orientation": (
        lambda: Image.open(Path("renders/a/2.png").rename("renders/a/2.jpg")).save(
            "renders/a/2.jpg", exif=TURNED
        ),
        "renders/a/2.jpg, EXIF: expected pixels stored upright, found orientation 3",
    ),
    "a damaged image": (lambda: Path("truth/a/10.png").write_bytes(b"no image"), "truth/a/10.png: .*PNG or JPEG"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_what_cannot_be_paired_is_refused_by_name(folders, capsys, fault):
    spoil, message = FAULTS[fault]
    spoil()
    words = ["renders", "--truth", "truth", "--masks", "masks", "--metrics", "l1", "--out", "out.csv"]
    resize = ["--resize", "area"] if fault == "another ratio" else []
    assert cli.main(["evaluate", *words, *resize]) == 2
    found = capsys.readouterr()
    assert not found.out
    assert re.search(message, " ".join(found.err.split()))
    assert not Path("out.csv").exists()


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        ("fps", "of kind avatar"),
        ("lpips-face", "visible face. Give its pixels with --masks"),
        ("psnt", "psnr"),
    ],
)
def test_metrics_that_need_more_than_images_are_refused(folders, capsys, metric, message):
    assert cli.main(["evaluate", "renders", "--truth", "truth", "--metrics", metric]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--device", "banana"], "device, banana"),
        (["--truth", "a/../renders"], "--truth: expected another folder or file than the renders"),
        (["--out", "renders/a/2.png"], "--out: expected a CSV file to write, found renders/a/2.png"),
    ],
)
def test_options_that_cannot_be_meant_are_refused(folders, capsys, words, message):
    Path("a").mkdir()
    before = read_png(Path("renders/a/2.png"))
    assert cli.main(["evaluate", "renders", "--truth", "truth", "--metrics", "l1", *words]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    np.testing.assert_array_equal(read_png(Path("renders/a/2.png")), before)


def test_a_wrong_network_is_found_first(folders, capsys, monkeypatch):
    """Before the metrics of single frames are computed for all pairs."""
    read = []
    monkeypatch.setattr(module.PairedImages, "image", lambda self, key: read.append(key) or picture())
    monkeypatch.setenv("HEADBENCH_INCEPTION", "truth/a/2.png")
    assert cli.main(["evaluate", "renders", "--truth", "truth", "--metrics", "l1,fid"]) == 2
    assert "truth/a/2.png: expected a PyTorch file of weights" in capsys.readouterr().err
    assert {key.sequence + str(key.timestep) for key in read} == {"a0"}


@pytest.fixture
def videos(folders):
    """Videos of twelve frames."""
    for folder in ("renders", "truth"):
        frames = [cv2.GaussianBlur(picture(), (0, 0), 3) for _ in range(12)]
        write_browser_video(folders / folder / "clip.webm", frames, 25, "test")
    return folders / "renders" / "clip.webm", folders / "truth" / "clip.webm"


@pytest.mark.parametrize("whole", [True, False], ids=["files", "folders"])
def test_videos_are_compared_frame_by_frame(videos, capsys, whole):
    words = [str(path if whole else path.parent) for path in videos]
    for folder in [] if whole else ("renders", "truth"):
        for name in NAMES:
            Path(folder, f"{name}.png").unlink()
    _, rows = evaluated(capsys, words[0], "--truth", words[1], "--metrics", "psnr,outside_metric:JUMP")
    frames = zip(*(video_frames(path) for path in videos))
    assert [float(row["psnr"]) for row in rows] == [psnr(a.image, b.image) for a, b in frames]
    assert [row["name"] for row in rows][::11] == ["clip/00000", "clip/00011"]
    assert all(row["jump"] for row in rows)


@pytest.mark.parametrize("with_person", [True, False])
def test_an_empty_frame_of_a_lossy_mask_is_empty(videos, capsys, with_person):
    """It holds low levels of the codec, which are refused only where no frame has others."""
    empty, inside = (np.dstack([levels] * 3) for levels in (np.full_like(INSIDE, 9), INSIDE))
    write_browser_video(
        Path("masks/clip.webm"), [empty] * 6 + [inside if with_person else empty] * 6, 25, "test"
    )
    words = [str(videos[0]), "--truth", str(videos[1]), "--masks", "masks/clip.webm", "--metrics", "psnr"]
    if not with_person:
        assert cli.main(["evaluate", *words]) == 2
        assert re.search(r"masks/clip.webm: .* levels up to \d+", " ".join(capsys.readouterr().err.split()))
        return
    _, rows = evaluated(capsys, *words)
    assert [bool(row["psnr/mask"]) for row in rows] == [False] * 6 + [True] * 6


def test_videos_of_other_lengths_are_refused(videos, capsys):
    write_browser_video(videos[1], [picture() for _ in range(11)], 25, "test")
    assert cli.main(["evaluate", str(videos[0]), "--truth", str(videos[1])]) == 2
    assert "clip.webm, frames: expected 32x24 pixels, 11 frames" in " ".join(capsys.readouterr().err.split())


def test_frames_of_a_video_are_found_in_any_order(videos):
    video = _Video(videos[0])
    video._most = 3
    expected = [frame.image for frame in video_frames(videos[0])]
    for number in (0, 2, 1, 11, 3, 4, 0):
        np.testing.assert_array_equal(video.frame(number), expected[number])
    assert len(video._kept) <= 3
