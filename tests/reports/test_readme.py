"""What is published of a suite: its run without this machine's folders."""

from headbench.bench.engine.store import RunFolder
from headbench.bench.manifest import PROTOCOLS
from headbench.reports import readme


def test_the_run_of_a_suite_is_published_without_folders(write_run, tmp_path, monkeypatch):
    page = tmp_path / "public" / "README.md"
    for name in (readme.SUITE, readme.PROTOCOLS, readme.DROPS, readme.ABLATIONS):
        written = page.parent / readme.PAGES[name]
        written.parent.mkdir(parents=True, exist_ok=True)
        written.write_text("\n".join(readme.marks(name)))
    write_run("run", {"ga": 30.0, "ours": 31.0})
    monkeypatch.setattr(readme, "suite_results", lambda folder: "tables")
    monkeypatch.setattr(readme, "drops_block", lambda folder: "block")
    monkeypatch.setattr(readme, "ablations_block", lambda folder: "block")
    monkeypatch.setattr(readme, "suite_block", lambda root: "block")
    readme.publish_suite(tmp_path, page.parent)
    target = page.parent / readme.GALLERY / readme.SUITE
    found = {path.relative_to(target).as_posix() for path in target.rglob("*.json")}
    protocols = {f"run/{PROTOCOLS}/hash-{task}.json" for task in ("novel_view", "self_reenactment")}
    assert found == {"run/run.json", *protocols}
    published = RunFolder(target / "run").read_manifest()
    assert published.protocols == RunFolder(tmp_path / "run").read_manifest().protocols
    assert published.configuration.out == ""
