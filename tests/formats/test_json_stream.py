import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.errors import FormatError
from lcf3d.formats.json_stream import JsonCursor, iterate_records

records = st.lists(
    st.dictionaries(
        st.text(max_size=3), st.one_of(st.text('{}[],"\\ \n', max_size=12), st.integers(), st.none()), max_size=3
    ),
    max_size=8,
)


@settings(deadline=None)
@given(records, st.integers(1, 40), st.sampled_from([None, 0, 2]))
def test_batches_of_any_size_hold_all_records(tmp_path_factory, values, size, indent) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path_factory.mktemp("stream") / "table.json"
    path.write_text(json.dumps(values, indent=indent), encoding="utf-8")
    assert [record for batch in iterate_records(path, size) for record in batch] == values


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('{"a": 1}', "must hold a list"),
        ('[{"a": 1}, {"a": ', "cut off"),
        ("[1, 2]", "holds ints"),
        ("", "must hold a list"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "table.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=complaint):
        list(iterate_records(path, 4))


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="does not exist"):
        list(iterate_records(tmp_path / "none.json"))


def test_cursor_sees_repeated_keys() -> None:
    cursor = JsonCursor(' { "a" : [1, {"b": 2}] , "c": {"d": 3, "d": 4}, "e": {} }')
    seen = []
    for key in cursor.members():
        seen.append((key, [(inner, cursor.value()) for inner in cursor.members()] if key != "a" else cursor.value()))
    assert seen == [("a", [1, {"b": 2}]), ("c", [("d", 3), ("d", 4)]), ("e", [])]


@pytest.mark.parametrize("text", ["[]", '{"a" 1}', '{"a": 1 "b": 2}', "{1: 2}", '{"a": 1'])
def test_cursor_refuses_what_is_no_object(text: str) -> None:
    with pytest.raises(json.JSONDecodeError):
        _walk(JsonCursor(text))


def _walk(cursor: JsonCursor) -> None:
    for _ in cursor.members():
        cursor.value()
