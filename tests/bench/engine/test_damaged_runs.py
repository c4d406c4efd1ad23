"""A run that is started again with files damaged makes them again, says so in one line, and ends as an unbroken one."""

import dataclasses

import pytest

from headbench.bench.engine import rendering
from headbench.bench.engine import run as runner
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import digest_file, write_json
from headbench.bench.io.images import read_png, write_png
from headbench.bench.rows import Rows

FRAME = "renders/novel_view/EMO_00001_b.png"
AVATAR = "avatar/level.txt"


@pytest.fixture
def run(run, cell):
    """A finished run: its folder, its cell's folder, its rows."""
    return run, cell.folder, Rows.read(run / "rows.parquet")


def warnings(caplog):
    return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


def altered(path):
    write_png(path, read_png(path) + 3)


def set_json(**values):
    return lambda path: write_json(path, {**read_json(path), **values})


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-5]),
    "noise": lambda path: path.write_bytes(bytes(range(256))),
    "gone": lambda path: path.unlink(),
    "altered": altered,
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"5"),
    "types": set_json(fingerprint=5, status=[]),
    "names": set_json(files={"../../../other": "0"}),
    "format": set_json(further="entry"),
}
CASES = [
    *((FRAME, how, "rendered again", False) for how in ("empty", "noise", "altered")),
    *((AVATAR, how, "trained again", True) for how in ("gone", "longer")),
    *(("rows.parquet", how, "measured again", False) for how in ("cut", "gone")),
    *(("fit.json", how, "made again", True) for how in ("cut", "names", "types")),
    *((name, "format", "made again", False) for name in ("digests.json", "measure.json")),
]


@pytest.mark.parametrize(("name", "how", "remedy", "trains"), CASES)
def test_a_damaged_file_is_made_again_and_named(run, config, toy, caplog, name, how, remedy, trains):
    _, cell, rows = run
    frame = digest_file(cell / FRAME)
    DAMAGE[how](cell / name)
    again = runner.run(config)
    (message,) = warnings(caplog)
    assert str(cell / name) in message
    assert remedy in message
    assert again._table.equals(rows._table)
    assert digest_file(cell / FRAME) == frame
    assert toy.FITS == ["subject1"] * trains


@pytest.mark.parametrize(
    ("name", "how"), [("run.json", "noise"), ("rows.parquet", "noise"), ("run.json", "gone")]
)
def test_damaged_files_of_the_whole_run_are_written_over(run, config, name, how):
    root, _, rows = run
    DAMAGE[how](root / name)
    assert runner.run(config)._table.equals(rows._table)
    assert RunFolder(root).read_manifest().status == "done"


def test_many_damaged_frames_are_named_in_one_line(run, config, caplog):
    _, cell, _ = run
    for path in cell.glob("renders/*/*.png"):
        path.write_bytes(b"")
    runner.run(config)
    assert "is empty, 4 more are damaged; rendered again" in warnings(caplog)[0]


def test_what_depends_on_a_remade_file_is_made_again(run, config, toy, monkeypatch):
    """Another training gives another avatar: its frames, and what was measured of them, are its own."""
    _, cell, rows = run
    (cell / AVATAR).unlink()
    other = lambda self, config: setattr(self, "config", toy.ToyConfig(0.75))
    monkeypatch.setattr(toy.ToyMethod, "__init__", other)
    again = runner.run(config)
    assert not again._table.equals(rows._table)
    assert (read_png(cell / FRAME) == 191).all()


def test_a_renderer_that_renders_otherwise_is_measured_again(run, config, toy, monkeypatch):
    _, cell, rows = run
    (cell / FRAME).unlink()
    original = toy.ToyAvatar.render

    def darker(self, *arguments):
        frame = original(self, *arguments)
        return frame._replace(rgb=frame.rgb / 2)

    monkeypatch.setattr(toy.ToyAvatar, "render", darker)
    again = runner.run(config)
    assert (again._table["value"] != rows._table["value"]).sum() == 1
    assert again._table.drop(columns="value").equals(rows._table.drop(columns="value"))


def test_frames_without_a_record_are_rendered_again(config, cell, toy, monkeypatch, caplog):
    whole = runner.run(dataclasses.replace(config, out=config.out + "-whole"))
    original = toy.ToyAvatar.render
    rendered = []

    def killed(self, *arguments):
        if len(rendered) == 3:
            raise KeyboardInterrupt
        rendered.append(1)
        return original(self, *arguments)

    monkeypatch.setattr(rendering, "RECORD_EVERY_S", -1.0)
    with monkeypatch.context() as patch:
        patch.setattr(toy.ToyAvatar, "render", killed)
        with pytest.raises(KeyboardInterrupt):
            runner.run(config)
    record = cell.step("digests")
    assert len(record["files"]) == 3
    del record["files"][FRAME]
    write_json(cell.folder / "digests.json", record)
    (cell.folder / FRAME).write_bytes(b"half a frame")
    rendered.clear()
    monkeypatch.setattr(toy.ToyAvatar, "render", lambda *a: rendered.append(1) or original(*a))
    assert runner.run(config)._table.equals(whole._table)
    assert len(rendered) == 3
    assert warnings(caplog) == []


def test_a_training_with_a_damaged_checkpoint_starts_over(config, cell, toy, monkeypatch, caplog):
    original = toy.ToyMethod.fit

    def fit(self, clip, out, budget, **settings):
        checkpoint = out / "checkpoint"
        if checkpoint.exists() and checkpoint.read_text() != "whole":
            raise InputError(checkpoint, "", "a checkpoint", "noise")
        out.mkdir(parents=True, exist_ok=True)
        checkpoint.write_text("half")
        if not self.config.fail:
            checkpoint.unlink()
        return original(self, clip, out, budget, **settings)

    monkeypatch.setattr(toy.ToyMethod, "fit", fit)
    rows = runner.run(config)
    state = cell.step("fit")
    cell.begin("fit", state["fingerprint"])
    (cell.avatar / "checkpoint").write_text("half")
    assert runner.run(config)._table.equals(rows._table)
    (message,) = warnings(caplog)
    assert f"{cell.avatar / 'checkpoint'}: expected a checkpoint, found noise" in message
    assert "trained from the start" in message
