from dataclasses import asdict, dataclass, field
from typing import ClassVar, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.configuration import build, merge, parse_assignments, with_first_names, with_new_names
from headbench.bench.errors import InputError
from headbench.bench.specs import Renamed


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


@given(
    st.dictionaries(
        st.sampled_from("abc"), st.integers() | st.dictionaries(st.sampled_from("xy"), st.integers())
    )
)
def test_merging_with_itself_or_nothing_changes_nothing(values):
    assert merge(values, values) == merge(values, {}) == merge({}, values) == values


@dataclass(frozen=True)
class Group:
    on: bool = True
    variant: Literal["paper", "official"] = "paper"
    later: int = 0


@dataclass(frozen=True)
class Now:
    """Once flat: ``group`` was the switch, ``how`` and the list ``odd`` what the variants were chosen by."""

    inner: Inner = field(default_factory=Inner)
    group: Group = field(default_factory=Group)
    odd_variant: Literal["paper", "official"] = "paper"
    size: Group = field(default_factory=Group)

    added: ClassVar = {"size": Group()}
    renamed: ClassVar = {
        "group": Renamed("group.on"),
        "how": Renamed("group.variant", {"": "paper", "code": "official"}),
        "odd:teeth": Renamed("odd_variant"),
    }


@pytest.mark.parametrize(
    ("values", "new"),
    [({"group": False}, "group.on"), ({"how": "code"}, "group.variant"), ({"odd": ["teeth"]}, "odd_variant")],
)
def test_an_old_name_is_refused_with_the_new_one(values, new):
    with pytest.raises(InputError, match=rf"a\.{new}"):
        build(Now, values, "file", "a.")


@pytest.mark.parametrize("stored", [{"odd": 5}, {"odd": None}, {"how": [{}]}, {"how": [["code"], 1.5]}])
def test_stored_settings_of_wrong_types_are_kept_until_used(stored):
    assert with_new_names(Now, stored).keys() <= {"odd_variant", "group"}


@dataclass(frozen=True)
class Faster:
    speed: int = 2

    added: ClassVar = {"speed": 1}


@pytest.mark.parametrize(("config", "first"), [(Faster(), {"speed": 2}), (Faster(speed=1), {})])
def test_a_later_setting_is_left_out_where_all_is_as_before(config, first):
    assert with_first_names(config) == first


def test_settings_stored_by_old_names_have_the_same_digest():
    stored = {"inner": {"rate": 0.5, "steps": 3}, "group": False, "how": "code", "odd": ["teeth"]}
    now = Now(Inner(0.5), Group(on=False, variant="official"), odd_variant="official")
    assert build(Now, with_new_names(Now, stored), "file") == now
    assert with_new_names(Now, asdict(now)) == asdict(now)
    first = with_first_names(now)
    assert first == {
        **stored,
        "odd": ("teeth",),
        "group.": {"later": 0},
    }  # a setting added since has no first name
    assert with_first_names(Now()) == {
        "inner": asdict(Inner()),
        "group": True,
        "how": "",
        "odd": (),
        "group.": {"later": 0},
    }
    assert with_first_names(Now(size=Group(on=False)))["size"] == asdict(Group(on=False))
