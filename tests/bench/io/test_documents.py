"""Documents from outside: what breaks a rule is refused in one short paragraph that names the place."""

import math
import os
import re
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.bench.io.documents import checked, parse_setting, read_json, read_yaml
from headbench.bench.io.files import write_json
from headbench.bench.io.style import policy_hash, stylesheet


def luminance(colour):
    """Relative luminance of "#rrggbb", WCAG 2."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear))


def contrast(a, b):
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


COLOURS = dict(re.findall(r"--([a-z0-9-]+): light-dark\((#[0-9a-f]{6}, #[0-9a-f]{6})\)", stylesheet()))
METHODS = [name for name in COLOURS if re.fullmatch("m[0-9]", name)]


@pytest.mark.parametrize("scheme", [0, 1])
@pytest.mark.parametrize("name", ["ink", "muted", "accent", "warn", "rule", *METHODS])
def test_colours_of_text_marks_and_borders_stand_out(scheme, name):
    paper, colour = (COLOURS[key].split(", ")[scheme] for key in ("paper", name))
    assert contrast(paper, colour) >= (3 if name == "rule" else 4.5)


def test_the_hash_is_that_of_the_standard():
    # The example of the CSP specification, "Hash usage for script elements".
    assert policy_hash("alert('Hello, world.');") == "sha256-qznLcsROx4GACP2dm0UCKCzCG+HiZ1guq6ZZDob/Tng="


TEXT = st.text(st.characters(max_codepoint=0xFFFF, exclude_categories=("Cs", "Cc")))
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | TEXT,
    lambda below: st.lists(below, max_size=3) | st.dictionaries(TEXT, below, max_size=3),
    max_leaves=10,
)
REFUSED = {
    read_json: [
        *("", "{", "[1]", "3", '"text"', '{"a":' * 10_000, '{"a": {"b": 1, "b": 1}}', '{"a": 1' + "0" * 5000),
        *('{"a": "' + "x" * 10**6, '{"' + "k" * 10**6 + '": 1, "a": NaN}', b"{\x81}", "\ufeff\ufeff{}"),
    ],
    read_yaml: [
        *("a: [", "\x00", "- 1", "a: b\n---\na: c", "a: 1\na: 2", "5: 1\n'5': 2", "true: 1", "[a]: 1"),
        *(
            "a: !!python/object/apply:os.system ['true']",
            "a: !!set {b}",
            "a: !!binary aGk=",
            "a: [1, !!bool x]",
        ),
        *("a: !!int ''", "a: !!timestamp x"),
    ],
}


@pytest.mark.parametrize(
    ("read", "text"), [(r, t) for r, texts in REFUSED.items() for t in texts], ids=lambda x: str(x)[:20]
)
def test_a_text_that_breaks_a_rule_is_refused_shortly(tmp_path, read, text):
    path = tmp_path / "a"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as caught:
        read(path)
    assert caught.value.file == str(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (read_json, '{"a": [1, {"b": [0.5, NaN]}]}'),
        (read_json, '{"a": [1, {"b": [0.5, 1e999]}]}'),
        (read_yaml, "a: [1, {b: [0.5, -.inf]}]"),
    ],
)
def test_a_number_that_is_not_finite_is_named_by_its_dotted_key(tmp_path, read, text):
    (tmp_path / "a").write_text(text)
    with pytest.raises(InputError, match=r"a, a\[1\].b\[1\]: expected a finite number"):
        read(tmp_path / "a")


@pytest.mark.parametrize("read", [read_json, read_yaml])
def test_what_is_no_file_to_read_is_refused(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for name, found in {"none": "no such file", "": "a folder", "pipe": "a pipe", "a\0": "null"}.items():
        with pytest.raises(InputError, match=found):
            read(tmp_path / name)


@pytest.mark.parametrize("read", [read_json, read_yaml])
@given(st.dictionaries(TEXT, PLAIN, max_size=3))
def test_what_keeps_the_rules_is_read_as_it_is(tmp_path_factory, read, value):
    """JSON is YAML, too, in version 1.2."""
    path = tmp_path_factory.mktemp("file") / "a.json"
    write_json(path, value)
    assert read(path) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(("1", 1), ("-2.5", -2.5), ("+3", 3), ("0", 0), ("1e-3", 0.001), (".5", 0.5), ("true", True)),
        *(("null", None), ("[a, 1]", ["a", 1]), ("{a: 1}", {"a": 1}), ("074", "074"), ("1_000", "1_000")),
        *(("2024-01-01", "2024-01-01"), ("1:30", "1:30"), ("<<", "<<"), ("=", "="), ("0x1F", "0x1F")),
    ],
)
def test_numbers_are_decimal_and_the_rest_is_text(tmp_path, text, value):
    assert parse_setting(text, "--set", "a") == value
    (tmp_path / "a.yaml").write_text(f"a: {text}\n")
    found = read_yaml(tmp_path / "a.yaml")["a"]
    assert (found, type(found)) == (value, type(value))


class Place(NamedTuple):
    name: str
    index: int


@dataclass(frozen=True)
class Part:
    share: float
    sides: tuple[int, ...] = ()

    def __post_init__(self):
        if self.share > 1:
            raise ValueError(f"share is {self.share}; up to 1")


@dataclass(frozen=True)
class Document:
    count: int
    parts: dict[str, Part] = field(default_factory=dict)
    places: tuple[Place, ...] = ()
    kind: Literal["a", "b"] = "a"
    optional: Part | None = None


def test_a_document_becomes_its_dataclass():
    value = {
        "count": 1,
        "parts": {"x": {"share": 1, "sides": [2, 3]}},
        "places": [["n", 4]],
        "optional": None,
    }
    assert checked(value, Document, "a.json") == Document(1, {"x": Part(1.0, (2, 3))}, (Place("n", 4),))
    assert checked({**value, "more": 1}, Document, "a.json", foreign=True).count == 1


@pytest.mark.parametrize(
    ("value", "key"),
    [
        ({}, "count"),
        ([], ""),
        ({"count": True}, "count"),
        ({"count": 1.0}, "count"),
        ({"count": "1"}, "count"),
        ({"count": 1, "parts": {"x": {"share": "1"}}}, "parts.x.share"),
        ({"count": 1, "parts": {"x": {"share": 2}}}, "parts.x"),
        ({"count": 1, "parts": {"x": {"share": 1, "sides": [1, 2.5]}}}, "parts.x.sides[1]"),
        ({"count": 1, "places": [["n", 1], ["n"]]}, "places[1][1]"),
        ({"count": 1, "kind": "c"}, "kind"),
        ({"count": 1, "optional": 3}, "optional"),
        ({"count": 1, "parts": {"x" * 10**6: None}}, None),
        ({"count": "\x1b[31m" * 10**6}, "count"),
        ({"count": math.nan}, ""),
    ],
    ids=lambda value: str(value)[:30],
)
def test_a_wrong_entry_is_named_by_its_dotted_key(value, key):
    with pytest.raises(InputError) as caught:
        checked(value, Document, "a.json")
    assert key is None or caught.value.key == key
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("read", [read_json, read_yaml])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_text_of_windows_editors_is_read_or_refused_by_name(tmp_path, read, encoding):
    path = tmp_path / "a"
    path.write_bytes('{"a": 1,\r\n "b": "é"}\r\n'.encode(encoding))
    if encoding.startswith("utf-8"):
        assert read(path) == {"a": 1, "b": "é"}
    else:
        with pytest.raises(InputError, match=r"in UTF-8, found UTF-16 or UTF-32\. Save it as UTF-8"):
            read(path)
