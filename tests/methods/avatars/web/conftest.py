from typing import NamedTuple

import pytest

from headbench.bench.contracts import no_progress
from headbench.methods.avatars.settings import ExportHtmlSettings
from headbench.methods.avatars.web import export
from headbench.methods.avatars.web.bake import Source, WebAvatar

from ....world import finished


class Exported(NamedTuple):
    """An avatar, what was baked of it and the page that holds it."""

    source: Source
    baked: WebAvatar
    view: dict
    more: dict
    page: object
    findings: object


@pytest.fixture(scope="package")
def run():
    return finished()


@pytest.fixture(
    scope="package", params=[*(pytest.param(name, marks=pytest.mark.slow) for name in ("ga", "gbs")), "ours"]
)
def exported(run, request, tmp_path_factory):
    """A page of each method, as the command writes it."""
    kept = {}
    bake, encode = export.bake, export.encode

    def baked(source, *arguments):
        kept["source"], kept["baked"] = source, bake(source, *arguments)
        return kept["baked"]

    def encoded(avatar, view, more):
        kept["view"], kept["more"] = view, more
        return encode(avatar, view, more)

    page = tmp_path_factory.mktemp("page") / "avatar.html"
    capture = str(run.read_manifest().configuration.data)
    folder = str(run.cell("901", request.param, 0).folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "bake", baked)
        patch.setattr(export, "encode", encoded)
        settings = ExportHtmlSettings(
            folder, str(page), capture=capture, expressions=2, title="<script>x</script>"
        )
        findings = export.export_page(settings, no_progress)
    return Exported(**kept, page=page, findings=findings)
