"""Every rule finds the fault it is there for, blames nothing else, and keeps quiet about a good capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.io.images import ImageInfo
from headbench.datasets.ga.layout import Declaration
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.writer import SequencePlan
from headbench.datasets.head.arrays import save_head
from headbench.datasets.lint.catalogue import GROUPS, RULES, errors
from headbench.datasets.lint.command import lint_capture
from headbench.datasets.lint.rules import apply
from headbench.datasets.lint.settings import LintSettings

from ..head.toy import toy_head
from .faults import CAPTURES, FAULTS
from .good_capture import (
    HEIGHT,
    LENGTHS,
    WIDTH,
    GoodCapture,
    cameras,
    good_plan,
    read_grey,
    read_rgb,
    smooth_poses,
    write_good_capture,
    write_pixels,
)

PLANTED_APART = {"HB115", "HB510", "HB511", "HB513", "HB514", "HB515", "HB516", "HB517", "HB615"}


pytestmark = pytest.mark.usefixtures("one_torch_thread")


def codes(capture: GoodCapture, **settings) -> list[str]:
    # Fewer views than by default: one per timestep of this capture.
    _, findings = lint_capture(LintSettings(str(capture.union), views=24, **settings))
    return [finding.code for finding in findings]


def test_a_good_capture_has_no_findings(pristine):
    _, findings = lint_capture(LintSettings(str(pristine.union)))
    assert findings == []


@pytest.mark.parametrize("faults", CAPTURES, ids=lambda faults: " ".join(fault.code for fault in faults))
def test_planted_faults_are_found_and_nothing_else(faults, good):
    for fault in faults:
        fault.plant(good)
    found, planted = codes(good), {fault.code for fault in faults}
    assert planted <= set(found) <= planted.union(*(fault.companions for fault in faults))
    assert len(found) == len(set(found)), "one finding tells it, however many frames are at fault"


def test_every_rule_is_tried_explained_and_of_a_group():
    assert {fault.code for fault in FAULTS} | PLANTED_APART == {rule.code for rule in RULES}
    assert len({rule.code for rule in RULES}) == len(RULES)
    for rule in RULES:
        assert rule.code[:2] == "HB"
        assert rule.code[2] in GROUPS
        assert rule.title
        assert rule.remedy.endswith((".", "?"))


def short_plan(rig):
    """A plan of few timesteps with these cameras."""
    head = good_plan().head
    lengths = dict.fromkeys(LENGTHS, 3)
    sequences = [SequencePlan(n, smooth_poses(head, c, i)) for i, (n, c) in enumerate(lengths.items())]
    return good_plan(head=head, cameras=rig, sequences=sequences)


SHORT = {"ignore": ("HB110", "HB616")}


def test_a_point_off_the_centre_and_cy_from_the_other_edge(tmp_path):
    capture = write_good_capture(tmp_path, short_plan(cameras(WIDTH / 2 + 3.0, HEIGHT / 2 - 3.0)))
    assert codes(capture, **SHORT) == ["HB510"]
    replace(Declaration.read(capture.union), cy="top").write(capture.union)
    found = codes(capture, **SHORT)
    assert "HB511" in found
    assert any(error.startswith("HB511: ") for error in errors(read_capture(capture.union)))
    assert set(found) <= {"HB511", "HB510", "HB702", "HB701"}
    assert codes(capture, cy="bottom", **SHORT) == ["HB510"]


def test_a_width_beyond_the_limit_of_gaussian_avatars(pristine):
    evidence, _ = lint_capture(LintSettings(str(pristine.union), views=1, duplicates=0))
    path = next(iter(evidence.headers))
    of_width = lambda width: replace(
        evidence, pixels=replace(evidence.pixels, headers={path: ImageInfo(width, 2000, 3)})
    )
    rule = next(rule for rule in RULES if rule.code == "HB115")
    assert len(apply([rule], of_width(1604))) == 1
    assert apply([rule], of_width(1600)) == []


def test_alpha_in_the_image_is_a_mask_and_has_no_background(good):
    """RGBA over nothing: colours under transparent pixels are nobody's business."""
    for path in good.files("images"):
        mask = read_grey(path.parent.parent / "fg_masks" / path.name)
        image = read_rgb(path).astype(float)
        alpha = mask[..., None] / 255
        colour = np.where(alpha > 0, (image - (1 - alpha) * 255) / np.maximum(alpha, 1e-3), 0)
        write_pixels(path, np.dstack([np.clip(colour, 0, 255).round(), mask]).astype(np.uint8))
    good.without_masks()
    assert codes(good) == []


@pytest.fixture(scope="module")
def detailed(tmp_path_factory) -> GoodCapture:
    """A finer head in larger images, so that colours say where the skin is; all of FREE's expressions are new."""
    head = toy_head(48, version="toy2023")
    sequences = [SequencePlan(n, smooth_poses(head, c, i)) for i, (n, c) in enumerate(LENGTHS.items())]
    plan = good_plan(head=head, cameras=cameras(WIDTH / 2, HEIGHT / 2, scale=2)[1:3], sequences=sequences)
    return write_good_capture(tmp_path_factory.mktemp("detailed"), plan)


def test_right_expressions_explain_the_images(detailed):
    evidence, findings = lint_capture(LintSettings(str(detailed.union), views=8, ignore=("HB616",)))
    assert [finding.code for finding in findings] == []
    assert evidence.expression_fit is not None
    assert evidence.expression_fit.mean < 0.3
    assert evidence.expression_fit.median < 0.3


def test_coefficients_of_another_basis(detailed, tmp_path):
    """As many coefficients, the declared version: only the images tell that the basis is another one."""
    mixed = detailed.copied(tmp_path / "mixed")
    head = detailed.writer.plan.head
    other = toy_head(48, seed=7).expression_basis
    save_head(mixed.union / "head_model.npz", replace(head, expression_basis=other))
    evidence, findings = lint_capture(LintSettings(str(mixed.union), views=8, ignore=("HB616",)))
    assert [finding.code for finding in findings] == ["HB615"]
    assert evidence.expression_fit is not None
    assert min(evidence.expression_fit.mean, evidence.expression_fit.median) > 1.1
