"""Names out of a log: readable, none empty, no two alike."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.logs.names import distinct, readable


@pytest.mark.parametrize(
    ("text", "expected"),
    [(b"ATT\0\0", "ATT"), (b"a\x1b[31m\nb", "a_[31m_b"), (b"\xff", "\N{REPLACEMENT CHARACTER}"), (b"\0A", "unnamed")],
)
def test_what_cannot_be_shown_is_replaced(text: bytes, expected: str) -> None:
    assert readable(text) == expected


def test_a_number_tells_alike_names_apart_without_taking_another_ones() -> None:
    assert distinct(["a", "a", "a_2", "a"]) == ["a", "a_3", "a_2", "a_4"]
    assert distinct(["t_us", "A", "a"], taken=["t_us"]) == ["t_us_2", "A", "a"]
    assert distinct(["A", "a"], key=str.casefold) == ["A", "a_2"]


@given(st.lists(st.sampled_from(["a", "a_2", "a_3", "a_2_2", "A", "b"])))
def test_no_two_are_alike_and_firsts_keep_their_names(names: list[str]) -> None:
    made = distinct(names)
    assert len(set(made)) == len(names)
    for at, name in enumerate(names):
        if name not in names[:at]:
            assert made[at] == name
