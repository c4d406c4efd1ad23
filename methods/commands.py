"""Commands of this room. Light to import: implementations are named, not loaded."""

from ..bench.specs import CommandSpec

COMPACT = CommandSpec(
    name="compact",
    summary="Store an avatar of ours in about a fifteenth of its bytes; with a capture, measure what each part costs in quality.",
    implementation="headbench.methods.compact.command:run",
    settings="headbench.methods.compact.settings:CompactSettings",
    writes="out",
)

EXPORT_PLY = CommandSpec(
    name="export ply",
    summary="Write an avatar in one pose as a 3D Gaussian splatting PLY that common viewers open.",
    implementation="headbench.methods.gaussian_ply.command:run",
    settings="headbench.methods.gaussian_ply.settings:ExportPlySettings",
)

IMPORT_GA = CommandSpec(
    name="import ga",
    summary="Make an avatar of a GaussianAvatars PLY and the capture it was trained on.",
    implementation="headbench.methods.gaussian_ply.import_command:run",
    settings="headbench.methods.gaussian_ply.settings:ImportGASettings",
    writes="out",
)
