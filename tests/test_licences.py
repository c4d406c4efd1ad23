"""Licences of everything that an installation brings: they fit this project's Apache-2.0."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

FITTING = r"MIT|BSD|Apache|PSF|Python Software Foundation|ISC|MPL-2|Mozilla Public|HPND|LGPL|Lesser General"
"""LGPL and MPL are fine for libraries that are used unchanged and can be exchanged, as Python packages are."""
COPYLEFT = r"(?<!L)(?<!Lesser )A?GPL|(?<!Lesser )General Public License|Affero"
EXCEPTIONS = {"pymeshlab"}
"""GPL-3.0, called by `datasets/head/procedural` and `methods/gbs` alone. The README says what follows from it."""


CUDA = r"nvidia-|cuda-"
"""Packages of PyTorch's CUDA build, under NVIDIA's licences. Nothing here is linked to them or distributes them."""


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def installed_with(names: list[str]) -> dict[str, str]:
    """Licence texts, by name, of packages and of all that they require here, without extras."""
    found: dict[str, str] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if normalised(name) in found:
            continue
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue
        # The free text "License" may quote the licences of what a wheel bundles: only where nothing else is given.
        classifiers = [c for c in package.metadata.get_all("Classifier", []) if c.startswith("License")]
        texts = {field: package.metadata.get(field) for field in ("License-Expression", "License")}
        given = (texts["License-Expression"], "\n".join(classifiers), texts["License"])
        found[normalised(name)] = next(filter(None, given), "")
        requirements = map(Requirement, package.requires or [])
        waiting += [r.name for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]
    return found


def unfitting(licences: dict[str, str]) -> set[str]:
    return {
        name
        for name, text in licences.items()
        if not re.match(CUDA, name)
        if re.search(COPYLEFT, text) or not re.search(FITTING, text, re.IGNORECASE)
    }


def test_every_dependency_has_a_licence_that_fits_apache_2():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))["project"]
    named = [Requirement(text).name for text in project["dependencies"]]
    licences = installed_with(named)
    assert {"jinja2", *map(normalised, named)} <= set(licences)  # jinja2: required by torch
    assert unfitting(licences) == EXCEPTIONS


def test_licences_that_do_not_fit_are_found():
    licences = {
        "a": "GPL-3.0-only",
        "b": "License :: OSI Approved :: GNU Affero General Public License v3",
        "c": "AGPL-3.0",
        "d": "",
        "e": "proprietary",
        "f": "GPL3",
    }
    fitting = {
        "x": "LGPL-2.1",
        "y": "License :: OSI Approved :: GNU Lesser General Public License v3",
        "z": "MIT",
    }
    assert unfitting({**licences, **fitting}) == set(licences)
