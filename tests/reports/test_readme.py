"""What is published of a suite: runs without this machine's folders, their protocols once."""

from headbench.bench.manifest import PROTOCOLS
from headbench.bench.runner.store import RunFolder
from headbench.reports import readme


def test_runs_of_a_suite_are_published_with_protocols_once(write_run, tmp_path, monkeypatch):
    page = tmp_path / "public" / "README.md"
    page.parent.mkdir()
    page.write_text("\n".join(readme.marks("suite")))
    for name in ("run", "ablation-a"):
        write_run(name, {"ga": 30.0, "ours": 31.0})
    monkeypatch.setattr(readme, "suite_results", lambda folder: "tables")
    monkeypatch.setattr(readme, "suite_block", lambda folder: "block")
    readme.publish_suite(tmp_path, page)
    target = page.parent / readme.SUITE
    found = {path.relative_to(target).as_posix() for path in target.rglob("*.json")}
    own = {"run/run.json", "ablation-a/run.json"}
    assert found == own | {f"{PROTOCOLS}/hash-{task}.json" for task in ("novel_view", "self_reenactment")}
    published = RunFolder(target / "run").read_manifest()
    assert published.protocols == RunFolder(tmp_path / "run").read_manifest().protocols
    assert published.configuration.out == ""
