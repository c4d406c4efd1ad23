"""Commands of `methods`; no implementation is imported."""

from ..bench.specs import CommandSpec

PARITY = CommandSpec(
    name="run parity",
    group="compare",
    summary="Compare a method with its authors' code on one capture at equal settings.",
    settings="headbench.methods.official.parity.settings:ParitySettings",
    function="headbench.methods.official.parity.parity:compare",
    writes="out",
    kinds=("captures",),
)

COMPACT = CommandSpec(
    name="export compact",
    group="export",
    summary="Store an avatar of a native method by the common codec, at a tenth of its size or less.",
    settings="headbench.methods.avatars.compact.settings:CompactSettings",
    function="headbench.methods.avatars.compact.measure:compact_avatar",
    writes="out",
    kinds=("an avatar",),
)

EXPORT_HTML = CommandSpec(
    name="export html",
    group="export",
    summary="Write an avatar as one HTML file with sliders for expressions and joints.",
    settings="headbench.methods.avatars.web.settings:ExportHtmlSettings",
    function="headbench.methods.avatars.web.export:export_page",
)

EXPORT_PLY = CommandSpec(
    name="export ply",
    group="export",
    summary="Write an avatar in one pose as a 3D Gaussian splatting PLY.",
    settings="headbench.methods.avatars.settings:ExportPlySettings",
    function="headbench.methods.avatars.export:export_ply",
)

EXPORT_GLB = CommandSpec(
    name="export glb",
    group="export",
    summary="Write an avatar in one pose as binary glTF with splats.",
    settings="headbench.methods.avatars.settings:ExportGlbSettings",
    function="headbench.methods.avatars.export:export_glb",
)

EXPORT_SOG = CommandSpec(
    name="export sog",
    group="export",
    summary="Write an avatar in one pose as SOG, a compact format of web viewers.",
    settings="headbench.methods.avatars.settings:ExportSogSettings",
    function="headbench.methods.avatars.export:export_sog",
)

IMPORT_GA = CommandSpec(
    name="import ga",
    group="export",
    summary="Import a GaussianAvatars PLY as an avatar of the method ga.",
    settings="headbench.methods.avatars.settings:ImportGASettings",
    function="headbench.methods.avatars.import_ga:import_avatar",
    writes="out",
    kinds=("an avatar",),
)
