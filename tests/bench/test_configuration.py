from dataclasses import dataclass, field
from typing import ClassVar, Literal

import pytest

from headbench.bench import cli
from headbench.bench.configuration import build, deciding_settings, merge, parse_assignments
from headbench.bench.errors import InputError

AVATAR = "{command} avatar --out out"
PLY, GLB, SOG, HTML = (AVATAR.format(command=f"export {form}") for form in ("ply", "glb", "sog", "html"))
COMPACT, EVALUATE = AVATAR.format(command="export compact"), "evaluate images --out out"
IMPORT = "import ga a.ply --out out"
RENDER = "render avatar --capture c --out out"
UNION = "prepare nersemble --union-root unions"
RUN = "run --data d --out out"
NO_EFFECT = "without which it has no effect, found"
CASES = [
    (f"{COMPACT} --scale=2", f"--scale: expected --compare, {NO_EFFECT} none"),
    (f"{RENDER} --frames train --beyond 31", f"--beyond: expected --frames orbit, {NO_EFFECT} --frames train"),
    (f"{RENDER} --beside", f"--beside: expected --video, {NO_EFFECT} none"),
    (f"{RENDER} --frames orbit --video --beside", "--beside: expected --frames self_reenactment"),
    (f"{EVALUATE} --like r --tasks novel_view", "--tasks: expected no --like, with which it has no effect, found --like r"),
    (f"{EVALUATE} --like r --reader ga", "--reader: expected no --like"),
    (f"{EVALUATE} --clip c --trust", f"--trust: expected --like, {NO_EFFECT} none"),
    (f"{EVALUATE} --like r --method ga", f"--method: expected --avatar, {NO_EFFECT} none"),
    (f"{EVALUATE} --like r --avatar --names ga-official", "--names: expected no --avatar"),
    (f"{RUN} --executor inline --workers 2", f"--workers: expected --executor auto or processes, {NO_EFFECT} --executor inline"),
    (f"{RUN} --executor inline --set execution.restarts=2", "--set execution.restarts: expected --executor auto or processes or slurm"),
    (f"{RUN} --set execution.slurm.gpus=1", f"--set execution.slurm: expected --executor slurm, {NO_EFFECT} --executor auto"),
    (f"{RUN} --executor processes --set execution.poll_s=1", f"--set execution.poll_s: expected --executor slurm, {NO_EFFECT} --executor processes"),
    ("run extremes run --executor inline --set execution.threads=1", "--set execution.threads: expected --executor auto or processes"),
    ("run curve run --levels 1", f"--levels: expected --over tracking_error, {NO_EFFECT} --over budget"),
    ("run curve run --over tracking_error --fractions 1/2", "--fractions: expected --over budget or cameras or timesteps"),
    ("compare run --baseline b --captures same", f"--captures: expected --update, {NO_EFFECT} none"),
    ("compare run --baseline b --update --judge-speed", "--judge-speed: expected no --update"),
    *((f"{export} --timestep 3", f"--timestep: expected --capture, {NO_EFFECT} none") for export in (PLY, GLB, SOG)),
    (f"{HTML} --cy top", f"--cy: expected --capture, {NO_EFFECT} none"),
    (f"{IMPORT} --cy top", f"--cy: expected --capture, {NO_EFFECT} none"),
    (f"{IMPORT} --capture c --subject s", "--subject: expected no --capture"),
    ("export colmap c --out out --all-timesteps --timesteps 1", "--timesteps: expected no --all-timesteps"),
    (f"{UNION} --check", "--check: expected no --union-root"),
    ("prepare nersemble --root r --rejoin", f"--rejoin: expected --union-root, {NO_EFFECT} none"),
    ("lint --list --strict", "--strict: expected no --list"),
    ("lint c --thorough --views 49", "--views: expected no --thorough"),
    ("run parity ga --checkout c --out out --data d --size 96x138", "--size: expected no --data"),
    ("run parity ga --checkout c --out out --samples 5000", f"--samples: expected METHOD flashavatar or gbs or rgbavatar, {NO_EFFECT} METHOD ga"),
    ("frames c --out out --trust", "--trust: expected a run, with run.json, at c"),
    ("doctor check x:SPEC --reader ga", f"--reader: expected --data, {NO_EFFECT} none"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "expected"), CASES, ids=[line for line, _ in CASES])
def test_an_option_without_effect_is_refused_before_any_work(line, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(line.split()) == 2
    assert f"headbench: command line, {expected}" in " ".join(capsys.readouterr().err.split())
    assert not any(tmp_path.iterdir())


@dataclass(frozen=True)
class Inner:
    rate: float = 0.1
    steps: int = 3


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = field(default_factory=Inner)
    sizes: tuple[int, ...] = (1,)
    limit: int | None = None
    kind: Literal["a", "b"] = "a"
    on: bool = False


def test_nested_values_are_built_with_their_types():
    built = build(Outer, {"name": "x", "inner": {"rate": 1}, "sizes": [4, 5], "limit": 7}, "file")
    assert built == Outer("x", Inner(1.0), (4, 5), 7)
    assert isinstance(built.inner.rate, float)


@pytest.mark.parametrize(
    ("values", "key", "hint"),
    [
        ({"name": "x", "inner": {"rte": 1}}, "inner.rte", "Did you mean 'rate'"),
        ({"name": "x", "sizes": "1,b"}, "sizes[1]", "whole number"),
        ({"name": "x", "inner": {"steps": 2.5}}, "inner.steps", "whole number"),
        ({"name": "x", "on": 1}, "on", "true or false"),
        ({"name": "x", "kind": "c"}, "kind", "one of a, b"),
        ({"name": "x", "inner": 3}, "inner", "group"),
        ({"name": "x", "inner": {"rate": float("nan")}}, "inner.rate", "finite"),
        ({}, "name", "nothing"),
    ],
)
def test_a_wrong_value_names_file_key_expected_and_found(values, key, hint):
    with pytest.raises(InputError) as caught:
        build(Outer, values, "run.yaml")
    assert caught.value.file == "run.yaml"
    assert caught.value.key == key
    assert hint in str(caught.value)


def test_assignments_nest_and_know_numbers():
    expected = {"a": {"b": 1, "c": 0.001}, "d": "x", "e": [1, 2], "f": None, "g": True}
    assert parse_assignments(["a.b=1", "a.c=1e-3", "d=x", "e=[1, 2]", "f=null", "g=true"]) == expected


@pytest.mark.parametrize("texts", [["nothing"], ["=3"], ["a..b=1"], ["a=["], ["a=1", "a.b=2"]])
def test_a_malformed_assignment_is_refused(texts):
    with pytest.raises(InputError):
        parse_assignments(texts)


def test_merge_lays_one_over_the_other_without_changing_either():
    base, over = {"a": {"x": 1, "y": 2}, "b": 3}, {"a": {"y": 5}, "c": 6}
    assert merge(base, over) == {"a": {"x": 1, "y": 5}, "b": 3, "c": 6}
    assert base == {"a": {"x": 1, "y": 2}, "b": 3}


@dataclass(frozen=True)
class Placed:
    inner: Inner = field(default_factory=Inner)
    checkout: str = ""

    places: ClassVar = ("checkout",)


def test_where_something_lies_does_not_decide_results():
    decide = {"inner": {"rate": 0.1, "steps": 3}}
    assert deciding_settings((Placed(checkout="here"), None, 2)) == (decide, None, 2)
