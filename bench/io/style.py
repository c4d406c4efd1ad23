"""The shared style of HTML pages, its source expression for content security policies, and text in Markdown."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from pathlib import Path

SHAPES = (
    "M6 .5a5.5 5.5 0 1 0 0 11a5.5 5.5 0 1 0 0 -11z",
    "M1 1h10v10h-10z",
    "M6 .2L12 11H0z",
    "M6 -.6L12.6 6L6 12.6L-.6 6z",
    "M4.2 0h3.6v4.2h4.2v3.6h-4.2v4.2h-3.6v-4.2h-4.2v-3.6h4.2z",
    "M6 11.8L0 1H12z",
    "M2.2 0L6 3.8L9.8 0L12 2.2L8.2 6L12 9.8L9.8 12L6 8.2L2.2 12L0 9.8L3.8 6L0 2.2z",
    "M6 0L11.5 3v6L6 12L.5 9v-6z",
    "M0 4h12v4h-12z",
)
"""Marks of methods as SVG paths in a box of 12 by 12, one for each of the colours ``--m0`` to ``--m8``."""


@cache
def stylesheet() -> str:
    """The shared style as CSS: variables for colours, type and spacing, text, controls, tables, marks.

    Pages put it before their own style. It refers to no other file.
    """
    return Path(__file__).with_suffix(".css").read_text("utf-8")


def policy_hash(text: str) -> str:
    """Source expression of a script or a style in a content security policy: ``sha256-...``."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def escape_markdown(text: str) -> str:
    """Escape text for Markdown, on one line; an underscore within a word needs no escape."""
    return re.sub(r"([\\`*{}\[\]<>|#~&]|(?<!\w)_|_(?!\w))", r"\\\1", " ".join(text.split()))
