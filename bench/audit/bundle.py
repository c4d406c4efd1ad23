"""Bundles: the results of a run in one file, for a leaderboard and for verification by others."""

from __future__ import annotations

import re
import shutil
import tempfile
import zipfile
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Literal

from ..contracts import Progress, no_progress
from ..engine.job import DIGESTS
from ..engine.store import STAGES, RunFolder
from ..errors import InputError
from ..io.documents import checked, parse_json
from ..io.files import atomic_path, check_writable, digest_file, reading, write_json
from ..io.provenance import RENDER, source_type
from ..manifest import PROTOCOLS, Manifest, protocol_path
from ..rows import ALL, Rows
from ..specs import CommandResult
from .settings import BundleSettings, check_shown

INDEX = "bundle.json"
MAX_FILES = 200_000
MAX_BYTES = 8 * 2**30
"""Maximum ratio of unpacked to packed size; JSON is compressed by a factor of 30."""

_CELL = r"[^/\\]+/[^/\\]+/seed-\d+"
_NAMES = re.compile(
    rf"run\.json|rows\.parquet|{PROTOCOLS}/[^/\\]+\.json|{_CELL}/({'|'.join(STAGES)})\.json|{_CELL}/renders/[^/\\]+/[^/\\]+\.png"
)
_TIME = (1980, 1, 1, 0, 0, 0)  # of every file, so that equal results give equal bytes
_MODE = 0o100644 << 16


@dataclass(frozen=True)
class Bundle:
    """``bundle.json``.

    Attributes
    ----------
    by, link, comment : str
        Author, address of further information, and remarks, as given.
    headbench : str
        Version that wrote the bundle.
    renders : bool
        Whether the scored frames are included.
    files : dict[str, str]
        SHA-256 of every other file, by its path in the bundle.
    digital_source_type : str
        Source type of the frames, see `headbench.bench.io.provenance`; "" without frames.
    """

    by: str
    link: str
    comment: str
    headbench: str
    renders: bool
    files: dict[str, str]
    digital_source_type: str = ""
    format: Literal[1] = 1


def write_bundle(settings: BundleSettings, progress: Progress = no_progress) -> CommandResult:
    """Write a bundle of a finished run.

    Raises `InputError` for a run that is not finished, unknown methods, and frames that are missing or
    differ from their digests.
    """
    folder, out = RunFolder(Path(settings.run)), Path(settings.out)
    check_writable(out, "--out")
    manifest = folder.read_manifest()
    manifest.check_done(folder.manifest)
    folder.read_rows(manifest)
    rows = folder.rows_by_condition(manifest)
    known = tuple(dict.fromkeys(method.name for method in manifest.methods))
    for name in settings.methods:
        if name not in known:
            raise InputError(folder.manifest, "methods", f"methods of the run: {', '.join(known)}", name)
    methods = settings.methods or known
    with tempfile.TemporaryDirectory() as scratch:
        staged = RunFolder(Path(scratch))
        without_paths(manifest, methods).write(staged.manifest)
        rows.of_methods(methods).write(staged.rows)
        sources = {"run.json": staged.manifest, "rows.parquet": staged.rows}
        protocols = (protocol_path(staged.root, each.hash) for each in manifest.protocols.values())
        sources |= {path.relative_to(staged.root).as_posix(): path for path in protocols}
        sources |= _cell_files(folder, manifest, methods, renders=settings.renders)
        files = {name: digest_file(path) for name, path in sorted(sources.items())}
        index = staged.root / INDEX
        bundle = Bundle(
            *(settings.by, settings.link, settings.comment, version("headbench"), settings.renders, files),
            source_type(RENDER) if settings.renders else "",
        )
        write_json(index, asdict(bundle))
        with atomic_path(out) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for number, (name, path) in enumerate([(INDEX, index), *((n, sources[n]) for n in files)]):
                info = zipfile.ZipInfo(name, _TIME)
                info.external_attr = _MODE
                info.compress_type = zipfile.ZIP_DEFLATED if name.endswith(".json") else zipfile.ZIP_STORED
                with path.open("rb") as source, archive.open(info, "w") as target:
                    shutil.copyfileobj(source, target)
                progress(number + 1, len(files) + 1, name)
    size = out.stat().st_size
    text = f"{out}: {len(files)} files, {size / 1e6:.1f} MB, methods {', '.join(methods)}"
    return CommandResult(text, {"out": out, "bytes": size, "methods": methods, "renders": settings.renders})


def without_paths(manifest: Manifest, methods: tuple[str, ...]) -> Manifest:
    """The record of some methods of a run, without local paths."""
    config = manifest.configuration

    def named(path: object) -> str:
        return Path(str(path)).name

    settings = {
        key: named(value) if key in {name.rpartition(".")[2] for name in manifest.paths or {}} else value
        for key, value in config.reader_settings.items()
    }
    # Methods in a configuration may be named by their module.
    ran = list(dict.fromkeys(method.name for method in manifest.methods))
    asked = dict(zip(ran, config.methods)) if len(ran) == len(config.methods) else {}
    labels = {method.label for method in manifest.methods if method.name in methods}
    conditions = [c for c in config.conditions if not c.methods or set(c.methods) & set(methods)]
    config = replace(
        config,
        data=named(config.data),
        out="",
        source=config.source and named(config.source),
        conditions=tuple(replace(c, methods=tuple(m for m in c.methods if m in methods)) for c in conditions),
        methods=tuple(asked.get(name, name) for name in methods),
        settings={name: value for name, value in config.settings.items() if name in methods},
        reader_settings=settings,
        heads={name: named(path) for name, path in config.heads.items()},
    )
    return replace(
        manifest,
        configuration=config,
        methods=tuple(method for method in manifest.methods if method.name in methods),
        adapted=tuple(record for record in manifest.adapted if record.method in labels),
        paths=None,
    )


def _cell_files(
    folder: RunFolder, manifest: Manifest, methods: tuple[str, ...], *, renders: bool
) -> dict[str, Path]:
    """Records of the cells, and their frames if requested, by their path in the run."""
    files: dict[str, Path] = {}
    labels = [method.label for method in manifest.methods if method.name in methods]
    for clip, label, seed in product(manifest.clips, labels, manifest.configuration.seeds):
        cell = folder.cell(clip.subject, label, seed)
        paths = [cell.folder / f"{name}.json" for name in STAGES if cell.step(name) is not None]
        if renders:
            state = cell.step(DIGESTS)
            recorded = {} if state is None else state.get("files", {})
            damaged = cell.damage(recorded)
            for name, why in damaged.items():
                remedy = "Restart the run; it renders damaged frames again."
                raise InputError(cell.folder / name, "", "the frame that was rendered", f"it {why}", remedy)
            paths += [cell.folder / name for name in recorded]
        files |= {path.relative_to(folder.root).as_posix(): path for path in paths}
    return files


def check_results(folder: RunFolder, manifest: Manifest) -> Rows:
    """The rows of a finished run, checked: only frames of its protocols, without duplicates, and with valid protocol hashes.

    Raises `InputError` for invalid rows or protocols.
    """
    manifest.check_done(folder.manifest)
    for record in manifest.protocols.values():
        record.protocol(folder.manifest)
    folder.read_rows(manifest)
    rows = folder.rows_by_condition(manifest)
    rows.check()
    rows.check_protocols(folder.rows, {task: record.hash for task, record in manifest.protocols.items()})
    for task, record in manifest.protocols.items():
        wanted = {tuple(key) for key in record.keys}
        for region in rows.regions:
            if strange := rows.frames(task, region) - wanted:
                raise InputError(folder.rows, f"frames of {task}", "those of its protocol", str(min(strange)))
    known = {
        "subject": (
            {subject for record in manifest.protocols.values() for subject, _ in record.clips},
            rows.subjects,
        ),
        "seed": ({*map(str, manifest.configuration.seeds)}, {*map(str, rows.seeds(ALL))}),
    }
    for key, (own, found) in known.items():
        if found - own:
            raise InputError(
                folder.rows, key, f"those of the run: {', '.join(sorted(own))}", min(found - own)
            )
    return rows


def read_bundle(path: Path, into: Path) -> Bundle:
    """Check a bundle and unpack it as a run folder into ``into``, which is empty.

    Raises
    ------
    InputError
        The file is not a bundle, its files differ from their list or are of an unexpected kind, or the
        content exceeds the size or number of files allowed in a bundle.
    """
    with reading(path, "a bundle of `headbench bundle`"), zipfile.ZipFile(path) as archive:
        return _unpack(archive, path, into)


def _unpack(archive: zipfile.ZipFile, path: Path, into: Path) -> Bundle:
    sizes = {info.filename: info.file_size for info in archive.infolist()}
    if sum(sizes.values()) > MAX_BYTES:
        raise InputError(path, "", f"files of at most {MAX_BYTES} bytes", f"{sum(sizes.values())}")
    if INDEX not in sizes:
        raise InputError(path, INDEX, "a list of the files", "none")
    bundle = checked(parse_json(archive.read(INDEX), path, INDEX), Bundle, path)
    check_shown(bundle, f"{path}, {INDEX}")
    held = set(sizes) - {INDEX}
    for name in sorted(held ^ set(bundle.files)):
        where = "in the list only" if name in bundle.files else "not in the list"
        raise InputError(path, name, f"the files that {INDEX} lists", where)
    for name in sorted(held):
        if not _NAMES.fullmatch(name) or {".", ".."} & set(name.split("/")):
            raise InputError(path, name, "files of a run", "another")
    for name, expected in bundle.files.items():
        target = into / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with archive.open(name) as source, target.open("xb") as copy:
            shutil.copyfileobj(source, copy)
        if digest_file(target) != expected:
            raise InputError(path, f"{name}, digest", expected[:12], digest_file(target)[:12])
    return bundle
