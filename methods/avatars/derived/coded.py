"""Coded variants of trained avatars, for every native method: the same codec at several steps."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from ....bench.contracts import Avatar, Clip, Variant
from ....bench.engine.config import CODED
from ...shared.avatar_files import read_shared_head
from ..compact.precision import Precision

STEPS = (1.0, 0.25, 0.5, 2.0, 4.0)
"""Factors of all quantisation steps."""


def coded_name(step: float) -> str:
    """Name of a variant by the factor of its steps: "coded", "coded-x0.5"."""
    return CODED if step == 1 else f"{CODED}-x{step:g}"


def coded_summary(step: float) -> str:
    """Description of that variant."""
    return "quantised by visible effect, compressed" + (f", steps times {step:g}" if step != 1 else "")


def _variants(module: str, name: str, folder: Path, clip: Clip, device: str) -> Iterator[Variant]:
    """The coded variants of an avatar of the class ``name`` in a module of `methods`, for `MethodSpec.variants`."""
    avatar_class = getattr(import_module(f"...{module}", __package__), name)
    for step in STEPS:
        make = partial(make_coded, avatar_class, folder, clip, device, step)
        yield Variant(coded_name(step), coded_summary(step), make)


gbs_variants = partial(_variants, "gbs.avatar", "GBSAvatar")
gha_variants = partial(_variants, "gha.avatar", "GHAAvatar")
insta_variants = partial(_variants, "insta.avatar", "InstaAvatar")
rgbavatar_variants = partial(_variants, "rgbavatar.method", "RGBAvatarAvatar")
flashavatar_variants = partial(_variants, "flashavatar.method", "FlashAvatarAvatar")


def make_coded(avatar_class: Any, folder: Path, clip: Clip, device: str, step: float, out: Path) -> Avatar:
    """Write the coded form of the avatar of a folder; return the avatar that is read back."""
    from ..compact.codecs import DRIVING_FILE, parts_of, write_coded

    avatar, head = avatar_class.read(folder, "cpu"), read_shared_head(folder)
    write_coded(parts_of(avatar, head, clip), head, out, Precision(step=step), folder / DRIVING_FILE)
    coded: Avatar = avatar_class.read(out, device)
    return coded
