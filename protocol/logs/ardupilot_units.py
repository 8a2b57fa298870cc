"""Units of the fields of an ArduPilot log, as its own records FMTU, UNIT and MULT say them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from protocol.logs.ardupilot_formats import Layout
from protocol.logs.names import readable
from protocol.logs.record_table import RecordTable, Unit


def field_units(tables: Mapping[str, RecordTable], layouts: Mapping[int, Layout]) -> dict[str, dict[str, Unit]]:
    """The units of fields by message and field; `layouts` are those of each type. A field with a scale needs no multiplier."""
    units = {int(row["Id"]) & 0xFF: readable(_bytes(row["Label"]), "") for row in _rows(tables, "UNIT", "Id", "Label")}
    multipliers = {int(row["Id"]) & 0xFF: float(f"{row['Mult']:.7g}") for row in _rows(tables, "MULT", "Id", "Mult")}
    found: dict[str, dict[str, Unit]] = {}
    for row in _rows(tables, "FMTU", "FmtType", "UnitIds", "MultIds"):
        layout = layouts.get(int(row["FmtType"]))
        if layout is None:
            continue
        unit_ids, multiplier_ids = _bytes(row["UnitIds"]), _bytes(row["MultIds"])
        for at, column in enumerate(layout.columns[: len(unit_ids)]):
            name = units.get(unit_ids[at], "")
            by = multipliers.get(multiplier_ids[at], 0.0) if at < len(multiplier_ids) else 0.0
            usable = by != 0 and math.isfinite(by) and column.divisor == 1
            if name:  # a multiplier of 0 means that there is none
                found.setdefault(layout.name, {})[column.name] = Unit(name, by if usable else 1.0)
    return found


_KINDS = {"Id": "iu", "FmtType": "iu", "Mult": "iuf", "Label": "SO", "UnitIds": "SO", "MultIds": "SO"}


def _rows(tables: Mapping[str, RecordTable], name: str, *fields: str) -> list[Any]:
    """The rows of a table; none where it lacks one of the fields, or one is not of the kind it should be."""
    table = tables.get(name)
    held: Mapping[str, Any] = (table.dtype.fields or {}) if table else {}
    if table is None or not all(field in held and held[field][0].kind in _KINDS[field] for field in fields):
        return []
    return list(table.rows())


def _bytes(value: bytes | str) -> bytes:
    return value.encode() if isinstance(value, str) else bytes(value)
