"""Avatars of methods that a test trains by itself, recorded as the runner does."""

from headbench.bench.contracts import Budget
from headbench.bench.engine.config import ResolvedMethod
from headbench.bench.engine.stored import write_avatar_record
from headbench.bench.registry import get, resolve


def recorded(folder, method, clip, config=None):
    """Write ``avatar.json`` beside an avatar of a registered method; return the folder."""
    spec = get("methods", method)
    resolved = ResolvedMethod(spec, config or resolve(spec.config)(), Budget())
    write_avatar_record(folder, resolved, clip.subject, clip.shape, clip.head.version, "training", {})
    return folder
