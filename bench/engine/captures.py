"""Opens the captures of a run with the requested reader and checks them against the contract."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

from ..condition import Named
from ..configuration import build_arguments
from ..contracts import Clip, Progress
from ..errors import HeadbenchError, InputError
from ..io.files import check_name
from ..progress import progress
from ..registry import finds, get, readers, resolve
from ..specs import LABEL, DatasetSpec, ResolutionRule, is_label
from .adaptation import MethodNeeds, adapt
from .config import RunConfig, RunOptions, resolve_change
from .store import RunFolder

Plugins = Literal["methods", "metrics"]
HARNESS = ("progress", "use_cache")
"""Keywords of a reader that are set by the harness, not by settings, see `DatasetSpec`."""


def open_clips(config: RunConfig, *, use_cache: bool = True, only: int | None = None) -> list[Clip]:
    """Open every capture under ``config.data``, validated by its reader, at the evaluated image size.

    ``use_cache`` is False to read every byte, ignoring the reader's cache. ``only`` is
    the index of a single capture to open, None for all.
    """
    spec: DatasetSpec = get("datasets", config.reader)
    root = Path(config.data)
    if not root.exists():
        raise InputError(root, "--data", "a capture folder", "no such folder")
    clips: list[Clip] = []
    captures = found_captures(spec, root, config.reader_settings, use_cache=use_cache)
    for path, read in captures if only is None else captures[only : only + 1]:
        with progress(f"reading {path.name}") as report:
            clips.append(changed(_reduced(_checked(read(report)), config), config.clip, config))
    subjects = [clip.subject for clip in clips]
    if len(set(subjects)) != len(subjects):
        raise InputError(root, "subject", "a different subject in each capture", ", ".join(subjects))
    return clips


def found_captures(
    spec: DatasetSpec, root: Path, settings: Mapping[str, Any], *, use_cache: bool = True
) -> list[tuple[Path, Callable[[Progress], Clip]]]:
    """Path of each capture that a reader finds under ``root``, and its reader."""
    if not spec.reads:
        raise InputError("reader", spec.name, "a dataset that is read", "one that makes captures")
    read = resolve(spec.implementation)
    arguments = build_arguments(read, settings, "reader_settings", harness=HARNESS)
    paths: Sequence[Path] = resolve(spec.find)(root) if spec.find else [root]
    if not paths:
        raise InputError(root, "", f"captures that reader {spec.name!r} knows", "none")
    asked = inspect.signature(read).parameters.keys() & HARNESS

    def reads(path: Path) -> Callable[[Progress], Clip]:
        def one(report: Progress) -> Clip:
            offered = {"progress": report, "use_cache": use_cache}
            clip: Clip = read(path, **arguments, **{name: offered[name] for name in asked})
            return clip

        return one

    return [(Path(path), reads(path)) for path in paths]


def reader_of(root: str) -> str:
    """Name of the reader for a run's capture: ga, unless only another reader finds one."""
    if not Path(root).exists() or finds(get("datasets", "ga"), Path(root)):
        return "ga"
    names = [name for name, spec in readers().items() if finds(spec, Path(root))]
    if len(names) > 1:
        expected = "a capture that one reader knows"
        raise InputError(root, "", expected, f"one for {', '.join(names)}", "Choose with the setting reader.")
    return names[0] if names else "ga"


def capture_configuration(
    data: str, out: str, reader: str = "", head: str | None = None, **others: Any
) -> RunConfig:
    """Settings that open a capture in the same way as a run; ``others`` are further fields of `RunConfig`.

    Parameters
    ----------
    reader : str
        Name of the dataset reader; "" selects it with `reader_of`.
    head : str | None
        Head model file, for captures without one.
    """
    reader = reader or reader_of(data)
    try:
        return RunConfig(
            data=data,
            out=out,
            reader=reader,
            reader_settings={} if head is None else {"head": head},
            **others,
        )
    except ValueError as error:
        raise HeadbenchError(f"command line: {error}") from error


def synthesis_arguments(steps: Sequence[Mapping[str, Any]], subject: str) -> dict[str, Any]:
    """All settings that reproduce the synthetic capture of one subject, from the steps recorded in its clip."""
    make = resolve(get("datasets", "synthetic").implementation)
    where, given = f"capture of {subject}", ("out", "pictures", "only", "execution", "workers", "progress")
    parameters = steps[0].get("parameters") if steps else None
    recorded = parameters.get("synthetic") if isinstance(parameters, Mapping) else None
    if not isinstance(recorded, Mapping) or not str(recorded.get("head")).startswith("procedural"):
        expected = "a folder, as only synthetic captures of the procedural head can be made again"
        raise InputError("--data", where, expected, "none", "Name the folder of the capture with --data.")
    defaults = {name: each.default for name, each in inspect.signature(make).parameters.items()}
    arguments = {name: default for name, default in defaults.items() if name not in given}
    settings = build_arguments(
        make,
        {"edition": 1, **{key: value for key, value in recorded.items() if key != "style"}},
        where,
        harness=given,
    )
    return {**arguments, **settings, "only": subject}


def located(config: RunConfig, **places: str | None) -> RunConfig:
    """The settings with absolute paths, so that their files are found from any directory; ``places`` replaces some by key."""
    paths = {key: os.path.abspath(value) for key, value in _named(config).items()}
    paths |= {key: place for key, place in places.items() if place is not None}
    groups: dict[str, dict[str, Any]] = {"reader_settings": {}, "heads": {}, "": {}}
    for key, path in paths.items():
        group, _, name = key.partition(".")
        groups[group if name else ""][name or group] = path
    settings, heads = ({**getattr(config, name), **groups[name]} for name in ("reader_settings", "heads"))
    return replace(config, **groups[""], reader_settings=settings, heads=heads)


PROGRAMS = "settings"
"""Key of names of methods that run a program, which their settings name."""


def check_trusted(
    run: Path, named: Mapping[str, Iterable[str]], given: Collection[str] = (), *, trust: bool
) -> None:
    """Refuse names by which a run folder, which may be of somebody else, would run code without consent.

    A name with ":" imports a module, a method may run a program.

    Parameters
    ----------
    run : Path
        The file with the names, for messages.
    named : Mapping[str, Iterable[str]]
        Names in the file by key of `RunConfig`; those of `PROGRAMS` are methods that run a program.
    given : Collection[str], optional
        Names in this command or its configuration file, which are allowed.
    trust : bool
        Allow all.
    """
    for key, names in named.items() if not trust else ():
        for name in names:
            if (":" in name or key == PROGRAMS) and name not in given:
                allowed = "methods without a program" if key == PROGRAMS else "registered ones"
                expected = f"names that run no code of others: {allowed}"
                raise InputError(run, f"configuration.{key}", expected, repr(name), _TRUST)


_TRUST = (
    "If you trust who made the run, name it in this call, or give --trust to a command that has this option."
)


def programs(names: Iterable[str]) -> list[str]:
    """The methods that run a program, of those with these names."""
    return [name for name in names if not get("methods", name).native]


def _names_of(config: RunConfig) -> dict[str, tuple[str, ...]]:
    """Names of plug-ins in a configuration by key, for `check_trusted`."""
    changes = [change.name for c in config.conditions for change in (c.clip, c.derive, c.drive, c.views)]
    return {
        "reader": (config.reader,),
        "conditions": (*changes, config.clip.name),
        "methods": config.methods,
        "metrics": config.metrics,
        "metric_profiles": config.metric_profiles,
    }


def run_configuration(
    run: Path,
    options: RunOptions,
    used: tuple[Plugins, ...] = ("methods", "metrics"),
    given: Collection[str] = (),
) -> RunConfig:
    """Settings of a run with the current locations of its folder and files.

    For ``used`` see `open_run_clips`, for ``given`` `check_trusted`.
    """
    folder = RunFolder(run)
    config = replace(folder.read_manifest().configuration, out=str(run))
    unused = [key for group, keys in _KEYS.items() if group not in used for key in keys]
    named = {key: names for key, names in _names_of(config).items() if key not in unused}
    check_trusted(folder.manifest, named, given, trust=options.trust)
    config = located(config, data=options.data, **{"reader_settings.head": options.head})
    for key, path in _named(config).items():
        if (
            key != "source" and not Path(path).exists()
        ):  # avatars of the source are needed only to derive them again
            remedy = _REMEDIES.get(key, "Put it there.")
            raise InputError(folder.manifest, f"configuration.{key}", path, "nothing there", remedy)
    return config


def open_run_clips(
    run: Path,
    options: RunOptions,
    *,
    out: Path | None = None,
    altered: bool = False,
    use_cache: bool = True,
    used: tuple[Plugins, ...] = ("methods", "metrics"),
) -> tuple[RunConfig, list[Clip]]:
    """Open the captures that a run was made from; return its settings as well, see `run_configuration`.

    Parameters
    ----------
    out : Path | None
        Replaces ``out`` of the settings, where results of slow steps may be stored. Default: the run
        folder, which the caller must have locked.
    altered : bool
        Return captures even if they differ from those of the run.
    use_cache : bool
        See `open_clips`.
    used : tuple[Plugins, ...]
        Plug-ins that the caller resolves from the returned settings. Names that would import a module
        are refused only for these and for the reader, since opening captures needs neither methods
        nor metrics.
    """
    config = run_configuration(run, options, used)
    config = config if out is None else replace(config, out=str(out))
    recorded = {clip.subject: clip.fingerprint for clip in RunFolder(run).read_manifest().clips}
    clips = open_clips(config, use_cache=use_cache)
    other = next((clip for clip in clips if recorded.get(clip.subject) != clip.fingerprint), None)
    if other is not None and not altered:
        raise InputError(
            config.data,
            f"subject {other.subject}",
            f"the capture of the run ({str(recorded.get(other.subject))[:12]})",
            f"another ({other.fingerprint[:12]})",
            "Name the folder of the capture with --data, or run again.",
        )
    return config, clips


_KEYS: dict[Plugins, tuple[str, ...]] = {"methods": ("methods",), "metrics": ("metrics", "metric_profiles")}
_REMEDIES = {
    "data": "Name the folder of the capture with --data.",
    "reader_settings.head": "Name the file of the head model with --head.",
}


def _named(config: RunConfig) -> dict[str, str]:
    """The files and folders that settings name, by dotted key."""
    hints = get_type_hints(resolve(get("datasets", config.reader).implementation))
    files = {
        f"reader_settings.{key}": value
        for key, value in config.reader_settings.items()
        if isinstance(value, str) and Path in (hints.get(key), *get_args(hints.get(key)))
    }
    source = {"source": config.source} if config.source else {}
    heads = {f"heads.{key}": path for key, path in config.heads.items()}
    return {"data": config.data, **files, **heads, **source}


def changed(clip: Clip, change: Named, config: RunConfig) -> Clip:
    """Apply a registered change to a clip; without a change, return the clip."""
    result: Clip = resolve_change(change, "clip")(clip, config)
    return result


def _reduced(clip: Clip, config: RunConfig) -> Clip:
    """The clip at the size at which metrics are computed."""
    needs = MethodNeeds(resolution=ResolutionRule(divide=config.divide))
    return adapt(clip, needs, {}, Path(config.out), f"reducing {clip.subject}").clip


def _checked(clip: Clip) -> Clip:
    """Check that names in the clip are valid in file names and results."""
    source = f"clip {clip.subject}"
    check_name(clip.subject, source, "subject")
    if not is_label(clip.fingerprint):
        raise InputError(source, "fingerprint", LABEL, repr(clip.fingerprint))
    for camera in clip.cameras:
        check_name(camera, source, "camera")
    for sequence in {key.sequence for keys in clip.splits.values() for key in keys}:
        check_name(sequence, source, "sequence")
    return clip
