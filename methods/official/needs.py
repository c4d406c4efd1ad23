"""Requirements of official methods on the machine, for ``headbench doctor``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...bench.errors import InputError
from ...bench.specs import Need
from .checkout import inspect_folder
from .flashavatar.method import FlashAvatarOfficial
from .ga.method import GAOfficial
from .gbs.method import GBSOfficial
from .gha.method import GHAOfficial
from .insta.method import INSTAOfficial
from .method import OfficialMethod
from .rgbavatar.method import RGBAvatarOfficial
from .spec import OfficialConfig
from .tga.method import TGAOfficial

METHODS: dict[type[OfficialConfig], type[OfficialMethod[Any]]] = {
    method.config_class: method
    for method in (
        *(FlashAvatarOfficial, GAOfficial, GBSOfficial, GHAOfficial),
        *(INSTAOfficial, RGBAvatarOfficial, TGAOfficial),
    )
}


def official(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout of the authors' code with its downloads, and the environment or the program that runs it."""
    method = METHODS[type(config)](config)
    try:
        folder, record = inspect_folder(method.name, config, method.repository)
    except InputError as error:
        yield Need("checkout", "", str(error))
    else:
        changed = f", {len(record['changed'])} files changed" if record.get("changed") else ""
        yield Need("checkout", f"{folder}, {record['commit'][:12] or 'no commit'}{changed}")
    try:
        _, versions = method.inspect_environment()
    except InputError as error:
        yield Need("environment", "", str(error))
    else:
        labels = {"python": "Python ", "torch": "torch "}
        parts = (f"{labels.get(name, '')}{value}" for name, value in versions.items())
        yield Need("environment", ", ".join(parts))
