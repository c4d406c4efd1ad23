"""Specs: every preset resolves, and the paper presets are the published values."""

from dataclasses import replace

import pytest

from headbench.bench.comparison import DemoConfig, demo_run_config
from headbench.bench.configuration import build
from headbench.bench.contracts import Budget
from headbench.bench.engine.config import RunConfig, resolve_method, resolve_methods
from headbench.bench.errors import InputError
from headbench.bench.registry import resolve
from headbench.methods.flashavatar.spec import FLASHAVATAR, FlashAvatarConfig
from headbench.methods.ga.spec import GA, GAConfig
from headbench.methods.gbs.spec import GBS, GBSConfig
from headbench.methods.gha.spec import GHA, GHAConfig
from headbench.methods.insta.spec import INSTA, InstaConfig
from headbench.methods.ours.spec import OURS, Lines, OursConfig, OuterLayers, Penalty, Planes, PlannedCapacity
from headbench.methods.rgbavatar.spec import RGBAVATAR, RGBAvatarConfig
from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.schedule import DensifySchedule, Timeline
from headbench.methods.trivial.spec import MEAN_IMAGE, NEAREST_CAMERA, ONE_PICTURE, TEXTURED_MESH

SPECS = {
    spec.name: spec
    for spec in (FLASHAVATAR, OURS, GA, GBS, GHA, INSTA, RGBAVATAR)
    + (MEAN_IMAGE, NEAREST_CAMERA, TEXTURED_MESH, ONE_PICTURE)
}
PRESETS = ("smoke", "quick", "demo", "fast", "gpu", "paper")


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("preset", PRESETS)
def test_presets_resolve(name, preset):
    spec = SPECS[name]
    settings = dict(spec.presets[preset])
    budget = build(Budget, settings.pop("budget"), "preset")
    assert budget.iterations
    implementation = resolve(spec.implementation)
    if spec.config:
        config = build(resolve(spec.config), settings, "preset")
        assert implementation(config).config == config
    else:
        assert settings == {}
        implementation()


def test_insta_is_refused_on_a_gpu_before_any_work(tmp_path):
    config = RunConfig("data", "out", methods=("ours", "insta"), device="cuda:1")
    with pytest.raises(
        InputError, match=r"device: expected cpu for method insta, found 'cuda:1'.*device=cpu"
    ):
        resolve_methods(config)
    with pytest.raises(InputError, match="device=cpu"):
        resolve(INSTA.implementation)().load(tmp_path, device="cuda")
    assert resolve_methods(replace(config, device="cpu"))
    everywhere, on_gpus = (demo_run_config(DemoConfig(), device)["methods"] for device in ("cpu", "cuda"))
    assert set(everywhere) - set(on_gpus) == {"insta"}


def test_the_quick_demo_has_all_methods_and_no_speed():
    quick, long = DemoConfig(), DemoConfig(preset="demo")
    short, full = (demo_run_config(config, "cpu") for config in (quick, long))
    assert short["methods"] == full["methods"]
    left_out = set(full["metrics"]) - set(short["metrics"])
    assert "fps" in left_out
    assert not left_out & {"psnr", "ssim", "lpips", "storage", "training_time"}
    assert quick.capture_arguments()["timesteps"] < long.capture_arguments()["timesteps"]
    given = replace(quick, cameras=3, size="48x64").capture_arguments()
    assert (given["cameras"], given["size"]) == (3, (48, 64))


@pytest.mark.parametrize("name", SPECS)
def test_a_run_records_the_version_of_the_method_that_it_runs(name):
    spec = SPECS[name]
    assert resolve_method(spec, "demo", {}).record()["version"] == resolve(spec.implementation).version


def values(settings, *names):
    return tuple(getattr(settings, name) for name in names)


RATES = ("position_lr", "position_lr_final", "opacity_lr", "scale_lr", "rotation_lr")
DIFFERENCES = [f"difference_{name}_lr" for name in ("position", "sh", "opacity", "scale", "rotation")]


def test_paper_presets_are_the_published_values():
    for spec in (OURS, GA):
        settings = dict(spec.presets["paper"])
        assert settings.pop("budget") == {"iterations": 600_000}
        config = build(resolve(spec.config), settings, "preset")
        assert config.splats == SplatTraining(split_variant="official")
    assert values(SplatTraining(), *RATES) == (5e-3, 5e-5, 0.05, 0.017, 1e-3)
    limits = values(SplatTraining(), "densify_gradient", "densify_extent", "prune_opacity")
    assert limits == (2e-4, 0.01, 0.005)
    rates = values(GAConfig(), "sh_dc_lr", "sh_rest_lr", "expression_lr", "pose_lr", "translation_lr")
    assert rates == (0.0025, 0.000125, 1e-3, 1e-5, 1e-6)
    published = build(OursConfig, {k: v for k, v in OURS.presets["paper"].items() if k != "budget"}, "preset")
    assert values(published.planes, "bounds_variant", "lr", "network_lr") == ("paper", 2e-3, 1e-4)
    assert values(published.lines, "start", "lr", "network_lr") == (60_000, 2e-3, 1e-4)


@pytest.mark.parametrize("preset", ["smoke", "quick", "demo", "fast"])
def test_short_presets_share_rates_that_paper_leaves_alone(preset):
    ga, gbs, ours = (resolve_method(spec, preset, {}).config for spec in (GA, GBS, OURS))
    assert values(ga.splats, *RATES) == values(ours.splats, *RATES) == (0.2, 1e-3, 0.05, 0.05, 0.01)
    assert values(gbs.splats, *RATES[2:]) == values(ga.splats, *RATES[2:])
    assert values(gbs, "sh_dc_lr", "sh_rest_lr") == values(ga, "sh_dc_lr", "sh_rest_lr") == (0.02, 1e-3)


@pytest.mark.parametrize(
    "spec", [FLASHAVATAR, OURS, GA, GBS, GHA, INSTA, RGBAVATAR], ids=lambda spec: spec.name
)
def test_the_gpu_preset_is_the_published_one_but_shorter(spec):
    ramp = {"penalty": {"ramp": 480_000}} if spec is OURS else {}  # from which lines act
    gpu, paper = (resolve_method(spec, *preset) for preset in (("gpu", {}), ("paper", ramp)))
    assert gpu.config == paper.config
    assert gpu.spec.resolution == paper.spec.resolution
    # INSTA's and RGBAvatar's published trainings are short already.
    assert min(paper.budget.iterations, 30_000) <= gpu.budget.iterations <= 60_000
    assert list(spec.presets)[-2:] == ["gpu", "paper"]


def test_the_paper_preset_of_gha_is_the_published_design():
    paper = resolve_method(GHA, "paper", {})
    assert paper.config == GHAConfig()
    rule = paper.spec.resolution
    assert (rule.square, rule.size, rule.speed_size) == ("pad", (2048, 2048), (1024, 1024))
    assert 2048 / paper.config.upscale == 512
    for preset in ("smoke", "quick", "demo", "fast"):
        assert resolve_method(GHA, preset, {}).spec.resolution.native


def test_the_paper_preset_of_gbs_is_the_paper():
    settings = dict(GBS.presets["paper"])
    assert settings.pop("budget") == {"iterations": 40_000}
    config = build(GBSConfig, settings, "preset")
    assert config == GBSConfig()
    sizes = values(config, "samples", "teeth_samples", "expressions", "sh_degree")
    assert sizes == (50_000, 5_000, 50, 3)
    splats = config.splats
    assert values(splats, *RATES) == (1.6e-4, 1.6e-6, 0.05, 0.005, 0.001)
    assert values(config, *DIFFERENCES) == (3.2e-7, 1.25e-3, 5e-5, 5e-4, 1e-4)
    assert values(splats, "densify_gradient", "prune_opacity") == (1e-3, 0.005)
    assert config.teeth_densify_gradient == 2e-4
    schedule = DensifySchedule.of(splats, Timeline(40_000, 40_000), white=True)
    rounds = [iteration for iteration in range(1, 40_001) if schedule.is_round(iteration)]
    assert rounds == list(range(600, 15_000, 100))
    assert not any(schedule.is_reset(iteration) for iteration in range(1, 40_001))


@pytest.mark.parametrize(
    ("config", "wrong"),
    [
        (SplatTraining, {"densify_every": 0}),
        (SplatTraining, {"initial_opacity": 1.0}),
        (SplatTraining, {"ssim_weight": 1.5}),
        (SplatTraining, {"max_splats": 0}),
        (SplatTraining, {"final_rate": 0.0}),
        (SplatTraining, {"scale_lr": -1e-3}),
        *(
            (RGBAvatarConfig, {"color_weight": -1.0, **more})
            for more in ({}, {"color_init_variant": "official"})
        ),
        *((RGBAvatarConfig, {"inputs": inputs}) for inputs in ((), ("smile",))),
        (RGBAvatarConfig, {"batch": 151, "online": True}),
        (RGBAvatarConfig, {"position_share": -1.0}),
        (RGBAvatarConfig, {"samples": 0}),
        (RGBAvatarConfig, {"batch": 0}),
        (RGBAvatarConfig, {"initial_scale_mm": 0.0}),
        (RGBAvatarConfig, {"position_lr_final": 0.0}),
        (RGBAvatarConfig, {"frame_variant": "official", "uv_chart": False}),
        (FlashAvatarConfig, {"samples": 0}),
        (FlashAvatarConfig, {"final_rate": 0.0}),
        (FlashAvatarConfig, {"frequencies": 17}),
        (FlashAvatarConfig, {"layers": 10**9}),
        (FlashAvatarConfig, {"offset_m": float("nan")}),
        (FlashAvatarConfig, {"mouth_weight": -1.0}),
        (GAConfig, {"sh_degree": 4}),
        (GHAConfig, {"channels": 33}),
        (GHAConfig, {"mesh_fraction": 1.0}),
        (GHAConfig, {"near_squared": 0.3}),
        (GHAConfig, {"sr_widths": ()}),
        (GHAConfig, {"max_points": 0}),
        (GHAConfig, {"unit": 0.0}),
        (GBSConfig, {"samples": 0}),
        (GBSConfig, {"expressions": -1}),
        (GBSConfig, {"difference_sh_degree": 4}),
        (GBSConfig, {"mask_floor_mm": 6.0}),
        (InstaConfig, {"level_features": 3}),
        (InstaConfig, {"ema": 1.0}),
        *((InstaConfig, {"step": wrong}) for wrong in (0.0, float("nan"))),
        (InstaConfig, {"levels": 0}),
        (InstaConfig, {"final_rate": 0.0}),
        (InstaConfig, {"log2_table": 0}),
        (InstaConfig, {"prior_scale": 0.0}),
        (Planes, {"resolution": 1}),
        (Lines, {"expressions": -1}),
        (Lines, {"dynamic": ()}),
        (Lines, {"dynamic": ("opacity", "opacity")}),
        (PlannedCapacity, {"tolerance": 0.0}),
        (PlannedCapacity, {"detail": 0.0}),
        (OuterLayers, {"count": -1}),
        (OuterLayers, {"gap": 0.0}),
        (OuterLayers, {"opacity": 1.0}),
        (Penalty, {"softness": -1.0}),
    ],
)
def test_settings_out_of_range_are_refused(config, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong)).split("_")[0]):
        config(**wrong)
