"""Formats of an ArduPilot log (FMT): what the bytes of a record mean, with pymavlink's names and scales."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from protocol.logs.names import distinct, readable
from protocol.logs.record_table import Column

KINDS: Mapping[str, tuple[str, tuple[int, ...], int]] = MappingProxyType(
    {
        **{"b": ("<i1", (), 1), "B": ("<u1", (), 1), "M": ("<u1", (), 1), "h": ("<i2", (), 1), "H": ("<u2", (), 1)},
        **{"i": ("<i4", (), 1), "I": ("<u4", (), 1), "q": ("<i8", (), 1), "Q": ("<u8", (), 1)},
        **{"g": ("<f2", (), 1), "f": ("<f4", (), 1), "d": ("<f8", (), 1), "a": ("<i2", (32,), 1)},
        **{"n": ("S4", (), 1), "N": ("S16", (), 1), "Z": ("S64", (), 1)},
        **{"c": ("<i2", (), 100), "C": ("<u2", (), 100), "e": ("<i4", (), 100), "E": ("<u4", (), 100)},
        "L": ("<i4", (), 10_000_000),
    }
)
"""Kind, shape and divisor of each letter of a format."""


class Layout(NamedTuple):
    """A message: its name, its fields in order, and how long its body is."""

    name: str
    columns: list[Column]
    size: int

    def offset_of(self, name: str, kind: str | None = None) -> int:
        """Where a field of that name (and kind) is in the body; -1 where there is none."""
        for column in self.columns:
            if column.name == name and kind in (None, column.kind):
                return column.offset
        return -1


def layout_of(name: str, letters: str, labels: str) -> Layout | None:
    """The message that a format describes; None where it holds a letter that stands for nothing.

    A field without a label is called by its number. Labels without a field are left out.
    """
    given = [readable(label, "") for label in labels.split(",")]
    columns, offset = [], 0
    names = distinct(given[at] if at < len(given) and given[at] else f"field_{at + 1}" for at in range(len(letters)))
    for label, letter in zip(names, letters, strict=True):
        if letter not in KINDS:
            return None
        kind, shape, divisor = KINDS[letter]
        columns.append(Column(label, kind, shape, offset, divisor))
        offset += np.dtype((kind, shape)).itemsize
    return Layout(name, columns, offset)
