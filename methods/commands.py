"""Commands of this room. Light to import: implementations are named, not loaded."""

from ..bench.contracts import CommandSpec

COMPACT = CommandSpec(
    name="compact",
    summary="Store an avatar of ours in a tenth of its bytes; with a capture, measure what each part costs in quality.",
    implementation="headbench.methods.compact.command:run",
    settings="headbench.methods.compact.settings:CompactSettings",
)
