"""What is stored of a run in the repository: no path of the machine that made it."""

from headbench.bench.engine.store import RunFolder
from headbench.bench.rows import Rows

from ..docs_ext import stored_results


def test_a_stored_run_has_no_folders_of_its_machine(write_run, tmp_path, change_manifest):
    run = write_run("run", {"ga": 30.0})
    local = {"data": "/home/me/data", "source": "/home/me/run", "heads": {"flame": "/home/me/flame.pkl"}}
    change_manifest(run, lambda m: m["configuration"].update(local))
    stored_results.store(run, tmp_path / "stored")
    text = (tmp_path / "stored" / "run.json").read_text()
    assert "/home" not in text
    assert str(tmp_path) not in text
    found, given = (RunFolder(folder).read_manifest() for folder in (tmp_path / "stored", run))
    assert (found.configuration.data, found.configuration.out) == ("data", "")
    assert (found.protocols, found.methods) == (given.protocols, given.methods)
    assert len(Rows.read(tmp_path / "stored" / "rows.parquet").subjects) == 4
