"""Requirements of official methods on the machine, for ``headbench doctor``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...bench.errors import InputError
from ...bench.specs import Need
from .checkout import inspect_folder
from .config import OfficialConfig
from .flashavatar.method import FlashAvatarOfficial
from .ga.method import GAOfficial
from .gbs.method import GBSOfficial
from .gha.method import GHAOfficial
from .insta.method import INSTAOfficial
from .method import OfficialMethod
from .rgbavatar.method import RGBAvatarOfficial
from .tga.method import TGAOfficial


def ga(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout and environment of GaussianAvatars."""
    return _needs(GAOfficial, config)


def tga(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout and environment of the method of `ours`."""
    return _needs(TGAOfficial, config)


def gbs(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout and environment of GaussianBlendshapes."""
    return _needs(GBSOfficial, config)


def gha(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout, its downloads, and environment of Gaussian Head Avatar."""
    return _needs(GHAOfficial, config)


def insta(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout of INSTA, the program built in it, and a GPU."""
    return _needs(INSTAOfficial, config)


def rgbavatar(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout and environment of RGBAvatar."""
    return _needs(RGBAvatarOfficial, config)


def flashavatar(config: OfficialConfig, device: str) -> Iterator[Need]:
    """Checkout of FlashAvatar, and its environment with the weights of its perceptual loss."""
    return _needs(FlashAvatarOfficial, config)


def _needs(method: type[OfficialMethod[Any]], config: OfficialConfig) -> Iterator[Need]:
    try:
        folder, record = inspect_folder(method.name, config, method.repository)
    except InputError as error:
        yield Need("checkout", "", str(error))
    else:
        changed = f", {len(record['changed'])} files changed" if record.get("changed") else ""
        yield Need("checkout", f"{folder}, {record['commit'][:12] or 'no commit'}{changed}")
    try:
        _, versions = method(config).inspect_environment()
    except InputError as error:
        yield Need("environment", "", str(error))
    else:
        known = {"python": "Python ", "torch": "torch "}
        yield Need(
            "environment", ", ".join(f"{known.get(name, '')}{value}" for name, value in versions.items())
        )
