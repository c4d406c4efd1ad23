from dataclasses import dataclass, field
from typing import ClassVar, Literal

import pytest

from headbench.bench.configuration import build, deciding_settings, merge, parse_assignments
from headbench.bench.errors import InputError


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
