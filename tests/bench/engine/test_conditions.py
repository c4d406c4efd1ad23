"""Conditions of a run: what is refused before any work, and what a later call may take from a run folder."""

from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.configuration import build
from headbench.bench.engine import run as runner
from headbench.bench.engine.config import RunConfig, resolve_cells
from headbench.bench.errors import InputError

HALF = Condition("half", budget="1/2")


def clip(name, /, **parameters):
    return Condition("c", clip=Named(name, parameters))


@pytest.mark.parametrize(
    ("condition", "match"),
    [
        (clip("cameras"), "conditions, cameras, parameters.part: expected a value"),
        (clip("cameras", prt="1/2"), "Did you mean 'part'"),
        (clip("variant", name="x"), "expected a change of kind 'clip', found one of kind 'derive'"),
        (clip("camera", part="1/2"), "Did you mean 'cameras'"),
        (Condition("c", methods=("other",)), "methods of c"),
        (Condition("c", settings={"levle": 1}), "Did you mean 'level'"),
    ],
)
def test_a_condition_that_cannot_be_had_is_refused(config, toy, condition, match):
    with pytest.raises(InputError, match=match):
        runner.run(replace(config, conditions=(PLAIN, condition)))
    assert toy.FITS == []
    assert not Path(config.out).exists()


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ({"conditions": [{}, {}]}, "each name once"),
        ({"conditions": [{"budget": "1/2"}]}, "a name for each"),
        ({"conditions": [{"name": "c", "budget": "2"}]}, "above 0 and at most 1"),
        ({"conditions": [{"name": "c", "derive": {"name": "variant"}}]}, "or a source that names"),
        (
            {"conditions": [{}, {"name": "c", "derive": {"name": "variant"}, "budget": "1/2"}]},
            "nothing is trained",
        ),
        ({"conditions": [{"name": "c", "views": {"name": "test-refit"}}]}, "or a source that names"),
        (
            {"conditions": [{"name": "c", "drive": {"name": "d"}, "views": {"name": "v"}}], "source": "r"},
            "both",
        ),
    ],
)
def test_conditions_that_are_none_are_refused(values, match):
    with pytest.raises(InputError, match=match):
        build(RunConfig, {"data": "d", "out": "o", **values}, "file.yaml")


def test_a_part_of_the_clip_out_of_range_fails_its_cell(config):
    rows = runner.run(replace(config, conditions=(PLAIN, clip("hold-out", every=8)))).rows
    assert rows.failed == []
    with pytest.raises(InputError, match="every: expected a whole number from 2"):
        runner.run(replace(config, out=f"{config.out}-2", conditions=(clip("hold-out", every=0),)))


def test_an_avatar_of_other_settings_is_no_source(config, toy):
    runner.run(config)
    driven = replace(config, out=f"{config.out}-2", source=config.out)
    assert runner.run(driven).rows.failed == []
    for setting, key in (
        ({"level": 0.9}, "config.level"),
        ({"budget": {"iterations": 7}}, "budget.iterations"),
    ):
        with pytest.raises(InputError, match=f"method.{key}: expected an avatar of the settings of this run"):
            runner.run(replace(driven, out=f"{config.out}-3", settings={"toy": setting}))
    with pytest.raises(
        InputError, match="avatar: expected a stored avatar, found none"
    ):  # it used another run's
        runner.run(replace(driven, out=f"{config.out}-4", source=driven.out))


def test_labels_of_methods_and_conditions_do_not_collide(config, toy, monkeypatch):
    plus = replace(toy.MIRROR, name="toy+dim")
    monkeypatch.setattr(toy, "MIRROR", plus)
    both = replace(config, methods=("toy_plugin:METHOD", "toy_plugin:MIRROR"))
    with pytest.raises(InputError, match="another name for a method or a condition"):
        resolve_cells(replace(both, conditions=(PLAIN, Condition("dim", ("toy",), {"level": 0.1}))))


def test_a_part_of_a_budget_leaves_out_methods_without_one(config, toy, monkeypatch):
    monkeypatch.setattr(toy, "MIRROR", replace(toy.MIRROR, presets={}))
    both = replace(config, methods=("toy_plugin:METHOD", "toy_plugin:MIRROR"))
    labels = [(m.spec.name, c.name) for m, c in resolve_cells(replace(both, conditions=(PLAIN, HALF)))]
    assert labels == [("toy", ""), ("toy", "half"), ("mirror", "")]
    with pytest.raises(InputError, match="a budget of mirror to take a part of"):
        resolve_cells(replace(both, conditions=(PLAIN, replace(HALF, methods=("mirror",)))))
