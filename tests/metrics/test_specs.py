import subprocess
import sys

import pytest

from headbench.bench.registry import resolve
from headbench.bench.specs import MetricSpec
from headbench.metrics import specs

SPECS = [value for value in vars(specs).values() if isinstance(value, MetricSpec)]


def test_every_metric_is_specified_once():
    assert [s.name for s in SPECS] == ["psnr", "ssim", "lpips", "storage", "fps"]
    assert {s.name for s in SPECS if not s.per_frame} == {"storage", "fps"}
    assert {s.name for s in SPECS if s.higher_is_better} == {"psnr", "ssim", "fps"}


@pytest.mark.parametrize("spec", SPECS, ids=lambda s: s.name)
def test_the_implementation_is_there(spec):
    assert callable(resolve(spec.implementation))


def test_listing_metrics_imports_neither_torch_nor_opencv():
    code = "import sys, headbench.metrics.specs; sys.exit(bool({'torch', 'cv2'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
