"""The experiments and the conditions that they register; light to import."""

from __future__ import annotations

from ..specs import CommandSpec, ConditionSpec

SUITE = CommandSpec(
    name="run suite",
    group="compare",
    summary="Run the benchmark suite: ten synthetic subjects, all methods; takes hours.",
    settings="headbench.bench.experiments.suite_settings:SuiteSettings",
    function="headbench.bench.experiments.suite:suite",
    writes="out",
)

SWEEP = CommandSpec(
    name="run sweep",
    group="compare",
    summary="Derive smaller and faster avatars without training, and measure them.",
    settings="headbench.bench.experiments.sweep_settings:SweepSettings",
    function="headbench.bench.experiments.sweep:sweep_run",
)

CURVE = CommandSpec(
    name="run curve",
    group="compare",
    summary="Measure quality against training time, cameras, timesteps or tracking error.",
    settings="headbench.bench.experiments.curve_settings:CurveSettings",
    function="headbench.bench.experiments.curve:curve_run",
)

HOLD_OUT = ConditionSpec(
    name="hold-out",
    summary="Holds a camera and every n-th timestep out of the training frames: scores no test frame.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:hold_out",
)

CAMERAS = ConditionSpec(
    name="cameras",
    summary="Trains with a part of the training cameras.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:fewer_cameras",
)

TIMESTEPS = ConditionSpec(
    name="timesteps",
    summary="Trains with a part of the training timesteps.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:fewer_timesteps",
)

TRACKING_ERROR = ConditionSpec(
    name="tracking-error",
    summary="Trains with another level of tracking error, of synthetic captures.",
    kind="clip",
    implementation="headbench.bench.experiments.tracking:with_tracking_error",
)

VARIANT = ConditionSpec(
    name="variant",
    summary="Derives a smaller or faster avatar without training, see `MethodSpec.variants`.",
    kind="derive",
    implementation="headbench.bench.experiments.sweep:variant",
)
