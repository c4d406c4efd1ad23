"""The suite's table of new poses and views: means over subjects, worst values of any frame."""

import json

from headbench.reports.suite.extremes import extremes_section, read_extremes


def avatar(subject, method, psnr, lpips, **more):
    measures = {
        "psnr": {"mean": psnr, "worst": psnr - 4, "frames": 10, "failed": 1},
        "lpips": {"mean": lpips, "worst": lpips + 0.2, "frames": 8, "failed": 0},
    }
    given = {"subject": subject, "method": method, "seed": 0, "frames": 10, "frames_broken": 1}
    return {**given, "measures": measures, "shown": ["a picture"], **more}


def test_rows_are_means_over_subjects_and_the_worst_frame(tmp_path):
    avatars = [avatar("900", "ga", 30.0, 0.1), avatar("901", "ga", 28.0, 0.2), avatar("900", "gbs", 1.0, 1.0)]
    avatars[2] |= {"missing": "no truth for its poses"}
    folder = tmp_path / "extremes"
    folder.mkdir()
    (folder / "record.json").write_text(json.dumps({"avatars": avatars}))
    found = read_extremes([tmp_path, tmp_path / "elsewhere"])
    assert [each["subject"] for each in found] == ["900", "901", "900"]
    assert not any("shown" in each for each in found)
    text = extremes_section(found)
    assert "| ga | psnr | 2 | 29.000 | 24.000 | 2 of 20 |" in text
    assert "| ga | lpips | 2 | 0.150 | 0.400 | 0 of 16 |" in text
    assert "Missing: `gbs`: no truth for its poses" in text
    assert "| gbs" not in text


def test_without_records_there_is_no_section(tmp_path):
    assert extremes_section(read_extremes([tmp_path])) == ""
