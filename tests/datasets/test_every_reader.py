"""Every command on captures works with the reader of a plug-in, whose clips have what `Clip` asks for and no more."""

import json

import pytest

from headbench.bench.cli import main
from headbench.bench.io.images import probe_image

COMMANDS = {
    "inspect": (["--timesteps", "1", "--cameras", "2"], ["inspection.png", "inspection.json"]),
    "inspect steps": (
        ["--bases", "3", "--clusters", "2"],
        ["jaw_bases.png", "expression_clusters.png", "steps.json"],
    ),
    "prepare tongue": (["--cameras", "1"], ["tongue.yaml", "tongue_901.png"]),
    "export colmap": (["--tracking"], ["sparse/0/images.bin", "flame_param/00000.npz", "head_model.npz"]),
}


@pytest.mark.commands
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_read_by_a_plugins_reader(plain_folder, tmp_path, command):
    options, files = COMMANDS[command]
    out = ["--reader", "plain_reader:SPEC", "--out", str(tmp_path / "out")]
    assert main([*command.split(), str(plain_folder), *out, *options]) == 0
    for file in files:
        assert (tmp_path / "out" / file).stat().st_size > 0
        if file.endswith(".png"):
            assert probe_image(tmp_path / "out" / file).width > 100


@pytest.mark.commands
def test_commands_take_settings_of_the_reader(plain_folder, tmp_path, capsys):
    labels = tmp_path / "labels.json"
    labels.write_text('{"0": "a hand"}')
    command = ["inspect", str(plain_folder), "--reader", "plain_reader:SPEC", "--out", str(tmp_path / "out")]
    assert main([*command, "--set", f"exclude={labels}", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sequences"][0]["excluded"] == 1
    assert main([*command, "--set", "exclud=x"]) == 2
    assert "exclude" in capsys.readouterr().err


def test_the_linter_says_which_checks_it_skips(plain_folder, capsys):
    main(["lint", str(plain_folder), "--reader", "plain_reader:SPEC", "--min-test-timesteps", "1", "--json"])
    data = json.loads(capsys.readouterr().out)
    assert {"HB101", "HB112", "HB601"} <= set(data["skipped"])
    assert not {"HB201", "HB301", "HB503", "HB701"} & set(data["skipped"])
    assert not {finding["code"] for finding in data["findings"]} & set(data["skipped"])
    assert data["looked_at"]["frames_decoded"] > 0
