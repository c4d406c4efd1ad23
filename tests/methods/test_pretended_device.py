"""Avatars on a device that is as strict as a GPU about where values are: they draw what they draw on the CPU."""

import json
import subprocess
import sys

import pytest
import torch

from .pretended_trial import METHODS, TRAINED


def result_of(module, folder):
    """What a program that prints JSON found."""
    command = [sys.executable, "-m", f"headbench.tests.{module}", str(folder)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return result_of("methods.pretended_trial", tmp_path_factory.mktemp("pretended"))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return result_of("methods.pretended_training", tmp_path_factory.mktemp("trained"))


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_frame_equals_that_of_the_cpu(found, method):
    assert found[method]["drawn"] > 0.05
    assert found[method]["difference"] < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_frame_waits_once_for_its_image(found, method):
    stages = found[method]["stages"].items()
    assert sum(stage.get("waits", 0) for name, stage in stages if name != "rasterize") == 1


# Adam turns rounding errors in gradients near 0 into steps of the learning rate, so the bounds are not tighter; those of gha
# are near 0 at its start, where the splats are round and nothing is added to their colours.
@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_training_equals_that_of_the_cpu_and_resumes(trained, method):
    assert trained[method]["difference"] < (0.2 if method == "gha" else 5e-3)
    assert trained[method]["resumed"] == 0
    assert trained[method]["operations"] > 0


@pytest.mark.slow
def test_commands_work_on_the_device(tmp_path):
    for done in result_of("commands_on_device", tmp_path):
        assert done["code"] == 0, f"{done['words']}\n{done['written']}"
        assert done["operations"] > 0, done["words"]


@pytest.mark.slow
@pytest.mark.parametrize("method", TRAINED)
def test_the_loss_of_training_waits_in_the_renderer_alone(found, method):
    stages = found[method]["loss"]
    assert stages["deform"]["operations"] > 0
    assert {name for name, stage in stages.items() if stage.get("waits")} <= {"rasterize"}


REFUSED = """
import numpy as np, torch
from headbench.tests.methods import pretended
pretended.register()
with pretended.pretended():
    there = torch.ones(4, 3, device=pretended.DEVICE)
    for attempt in (
        lambda: there + torch.ones(3),
        lambda: there.numpy(),
        lambda: torch.randn(3, device=pretended.DEVICE, generator=torch.Generator()),
    ):
        try:
            attempt()
        except Exception as error:
            print("refused", type(error).__name__)
    print("sum", (there * 2 + 1).sum().cpu().item())
"""


def test_the_device_refuses_what_cuda_refuses():
    done = subprocess.run([sys.executable, "-c", REFUSED], check=True, capture_output=True, text=True)
    assert done.stdout.count("refused") == 3
    assert f"sum {torch.full((4, 3), 3.0).sum().item()}" in done.stdout
