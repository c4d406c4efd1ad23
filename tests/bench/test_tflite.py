"""Networks of a package that pip downloads: only the expected files reach the cache."""

import hashlib
import subprocess
import zipfile

import pytest

from headbench.bench import tflite
from headbench.bench.errors import InputError, UnavailableError


@pytest.fixture
def pip(monkeypatch, tmp_path):
    """In place of pip: a call writes a wheel with these files."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = {network.path: path.encode() for path, network in tflite.NETWORKS.items()}
    expected = {
        name: tflite.NetworkFile(path, hashlib.sha256(name.encode()).hexdigest())
        for name, (path, _) in tflite.NETWORKS.items()
    }
    monkeypatch.setattr(tflite, "NETWORKS", expected)

    def run(command, **options):
        if files:
            with zipfile.ZipFile(command[command.index("--dest") + 1] + "/one.whl", "w") as wheel:
                for path, content in files.items():
                    wheel.writestr(path, content)
        return subprocess.CompletedProcess(command, 0 if files else 1, "", "no network")

    monkeypatch.setattr(subprocess, "run", run)
    return files


def test_files_of_the_package_are_kept(pip):
    found = tflite.fetch_networks()
    assert [path.read_text() for path in found] == [*tflite.NETWORKS]
    assert found == [tflite.fetched_network(name) for name in tflite.NETWORKS]


def test_another_file_is_refused(pip):
    pip[tflite.NETWORKS["detector"].path] = b"another"
    with pytest.raises(InputError, match="face_detection.*SHA-256"):
        tflite.fetch_networks()
    assert not tflite.fetched_network("detector").exists()


def test_without_a_network_or_pip_it_says_what_to_do(pip, monkeypatch):
    pip.clear()
    with pytest.raises(UnavailableError, match=f"no network.*pip download.*{tflite.WHEEL}"):
        tflite.fetch_networks()
    monkeypatch.setattr(tflite.importlib.metadata, "distributions", lambda **named: ())
    monkeypatch.setattr(tflite.shutil, "which", lambda name: None)
    with pytest.raises(UnavailableError, match="ensurepip"):
        tflite.fetch_networks()
