"""Avatars on a device that is as strict as a GPU about where values are: they draw what they draw on the CPU."""

import json
import subprocess
import sys

import pytest
import torch

from .pretended_trial import METHODS


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pretended")
    command = [sys.executable, "-m", "headbench.tests.methods.pretended_trial", str(folder)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_frame_equals_that_of_the_cpu(found, method):
    assert found[method]["drawn"] > 0.05
    assert found[method]["difference"] < 1e-4
    assert found[method]["operations"] > 0


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
