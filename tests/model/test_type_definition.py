"""Two definitions of a service type are the same, or the first field that differs is named."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.plain import from_plain, to_plain
from fogft.model.type_definition import Definition, difference, nested

TYPE = "my_msgs/srv/Detect"
HERE = {
    "request": (("image", "my_msgs/Image"), ("limit", "sequence<double, 5>")),
    "my_msgs/Image": (("width", "uint32"), ("height", "uint32")),
    "response": (("ok", "boolean"),),
}
kinds = st.sampled_from(["int32", "string<10>", "a/B", "sequence<a/B>", "a/B[3]", "c/D"])
fields = st.lists(st.tuples(st.sampled_from("uvwxyz"), kinds), unique_by=lambda f: f[0]).map(tuple)
definitions = st.builds(
    Definition,
    hash=st.sampled_from(["", "RIHS01_a", "RIHS01_b"]),
    fields=st.fixed_dictionaries(dict.fromkeys(("request", "response", "a/B", "c/D"), fields)),
    trouble=st.sampled_from(["", "no such package"]),
    service_hash=st.sampled_from(["", "RIHS01_s", "RIHS01_t"]),
)


def changed(**fields: object) -> Definition:
    return Definition(fields={**HERE, **fields})  # type: ignore[arg-type]


@given(definitions)
def test_a_definition_survives_the_wire(definition: Definition) -> None:
    assert from_plain(Definition, json.loads(json.dumps(to_plain(definition)))) == definition


@given(definitions)
def test_a_type_that_loads_is_the_same_as_itself(definition: Definition) -> None:
    assert bool(difference(TYPE, definition, definition)) == bool(definition.trouble)


@given(definitions, definitions)
def test_sameness_does_not_depend_on_the_side(one: Definition, other: Definition) -> None:
    assert bool(difference(TYPE, one, other)) == bool(difference(TYPE, other, one))


@given(definitions)
def test_without_a_hash_on_one_side_fields_decide(definition: Definition) -> None:
    """A robot on Humble and a replica on Jazzy with the same fields understand each other."""
    humble = Definition("", definition.fields, definition.trouble)
    assert bool(difference(TYPE, definition, humble)) == bool(definition.trouble)


@pytest.mark.parametrize(
    ("there", "words"),
    [
        (
            {"my_msgs/Image": (("width", "uint32"), ("height", "uint64"))},
            "field `request.image.height` is `uint32` here and `uint64` on the replica",
        ),
        ({"response": ()}, "field `response.ok` (`boolean`) is missing on the replica"),
        (
            {"response": (("ok", "boolean"), ("why", "string"))},
            "the replica has a further field `response.why` (`string`)",
        ),
        (
            {"my_msgs/Image": (("height", "uint32"), ("width", "uint32"))},
            "the order of fields differs: `request.image.width` here, `request.image.height` there",
        ),
    ],
    ids=["a nested type", "missing", "further", "order"],
)
def test_the_field_that_differs_is_named(there: dict[str, object], words: str) -> None:
    assert words in difference(TYPE, Definition(fields=HERE), changed(**there))


def test_different_hashes_of_the_same_fields_are_a_difference() -> None:
    """A hash may know what the fields do not tell."""
    found = difference(TYPE, Definition("RIHS01_a", HERE), Definition("RIHS01_b", HERE))
    assert "its hash is RIHS01_a here, RIHS01_b there" in found


def test_equal_hashes_need_no_look_at_the_fields() -> None:
    assert difference(TYPE, Definition("RIHS01_a", HERE), Definition("RIHS01_a", {})) == ""


@pytest.mark.parametrize("side", ["here", "on the replica"])
def test_a_type_that_cannot_be_loaded_is_told_with_its_side(side: str) -> None:
    broken, good = Definition(trouble="no package"), Definition(fields=HERE)
    pair = (broken, good) if side == "here" else (good, broken)
    assert difference(TYPE, *pair) == f"`{TYPE}` cannot be loaded {side}: no package"


@pytest.mark.parametrize("raw", [None, [], {"hash": 1, "fields": {}, "trouble": ""},
                                 {"hash": "", "fields": {"request": [["a"]]}, "trouble": ""},
                                 {"hash": "\ud800", "fields": {}, "trouble": ""}])  # fmt: skip
def test_what_is_no_definition_is_refused(raw: object) -> None:
    with pytest.raises(ValueError):
        from_plain(Definition, raw)


@pytest.mark.parametrize(
    ("kind", "of"),
    [("double", ""), ("string<10>", ""), ("sequence<float, 5>", ""), ("a_b/C", "a_b/C"),
     ("sequence<a/B, 3>", "a/B"), ("a/B[3]", "a/B"), ("sequence<string>", "")],
)  # fmt: skip
def test_what_a_field_is_made_of(kind: str, of: str) -> None:
    assert nested(kind) == of


def test_where_one_side_knows_no_fields_the_service_s_hash_decides() -> None:
    """A proxy that loads no type knows it by the hash in `rmw_zenoh`'s names alone."""
    here, same = (
        Definition(service_hash="RIHS01_s"),
        Definition(fields=HERE, service_hash="RIHS01_s"),
    )
    other = Definition(fields=HERE, service_hash="RIHS01_t")
    assert difference(TYPE, here, same) == ""
    assert "its hash is RIHS01_s here, RIHS01_t there" in difference(TYPE, here, other)
    for unknown in (Definition(fields=HERE), Definition(service_hash="TypeHashNotSupported")):
        assert difference(TYPE, here, unknown) == ""
