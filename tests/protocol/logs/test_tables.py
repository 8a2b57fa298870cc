"""Tables of a log: the values that pymavlink decodes, field by field, of every message of the dialect."""

from __future__ import annotations

import struct
from collections import Counter
from typing import Any

import numpy as np
import pytest
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as widest

from protocol.logs.dialect import layouts, layouts_by_name
from protocol.logs.scan import scan_tlog
from protocol.logs.tables import HEAD, table_dtype, tables
from tests.protocol.logs.log_records import DAY_US, FOREIGN, KNOWN, Pen, Record, mixed_records


def joined(records: list[Record]) -> bytes:
    return b"".join(record.data for record in records)


def bits(value: Any, like: np.ndarray[Any, Any]) -> bytes:
    """A value of pymavlink's as the bytes of the column's type, NaN and all."""
    if isinstance(value, str | bytes):
        raw = value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value
        return raw.split(b"\0")[0]
    return np.asarray(value, dtype=like.dtype).tobytes()


@pytest.mark.parametrize("version_1", [False, True])
def test_every_message_has_the_values_that_pymavlink_decodes(version_1: bool) -> None:
    pen = Pen()
    records = [pen.record(n, version_1=version_1) for n in KNOWN * 2 if n < 256 or not version_1]
    made = tables(scan_tlog(joined(records)))
    rows: Counter[str] = Counter()
    for record in records:
        message = widest.MAVLink(None).decode(bytearray(record.frame))
        name = message.get_type()
        row = made[name][rows[name]]
        rows[name] += 1
        assert (row["t_us"], row["system"], row["component"]) == (record.t_us, 1, 191)
        assert row["frame_sequence"] == message.get_seq()
        assert set(row.dtype.names) == {head for head, _ in HEAD} | set(message.fieldnames)
        layout = layouts_by_name()[name]
        expected = layout.unpack_fields(record.frame[6 if version_1 else 10 : -2])
        for field in message.fieldnames:
            value = expected[field]
            assert bits(value, row[field]) == bits(
                row[field] if row[field].dtype.kind != "S" else bytes(row[field]), row[field]
            )
            theirs = getattr(message, field)
            if isinstance(theirs, int | float | list):
                assert bits(theirs, row[field]) == row[field].tobytes(), (name, field)
    assert {name: len(table) for name, table in made.items()} == dict(rows)
    assert list(made) == [layouts()[n].name for n in KNOWN if n < 256 or not version_1]


def test_no_message_has_a_field_of_the_name_of_a_head() -> None:
    for message in layouts().values():
        assert not set(message.fields) & {name for name, _ in HEAD}
        assert table_dtype(message.name).itemsize == message.size + 11


def test_a_payload_cut_short_is_filled_with_zeros() -> None:
    mav = widest.MAVLink(None)
    frames = [bytes(widest.MAVLink_attitude_message(ms, 0, 0, 0, 0, 0, 0).pack(mav)) for ms in (0, 7, 70_000)]
    assert [frame[1] for frame in frames] == [1, 1, 3]
    made = tables(scan_tlog(joined([Record(DAY_US + n, frame) for n, frame in enumerate(frames)])))
    assert made["ATTITUDE"]["time_boot_ms"].tolist() == [0, 7, 70_000]
    assert not made["ATTITUDE"]["yawspeed"].any()


def test_a_payload_of_a_newer_definition_keeps_what_is_known() -> None:
    payload = struct.pack("<Iffffff", 5, 1, 2, 3, 4, 5, 6) + b"extension"
    body = struct.pack("<BBBBBB", len(payload), 0, 0, 9, 1, 1) + (30).to_bytes(3, "little") + payload
    frame = b"\xfd" + body + struct.pack("<H", mcrf4xx(body + bytes([widest.mavlink_map[30].crc_extra])))
    data = joined([Record(DAY_US, frame), Pen(t_us=DAY_US).record(0)])
    made = tables(scan_tlog(data))
    assert made["ATTITUDE"][0].tolist() == (DAY_US, 1, 1, 9, 5, 1, 2, 3, 4, 5, 6)
    assert len(made["HEARTBEAT"]) == 1


def test_a_choice_of_messages_and_rows() -> None:
    scan = scan_tlog(joined(mixed_records()))
    whole = tables(scan)
    assert sum(map(len, whole.values())) == 90
    name = max(whole, key=lambda key: len(whole[key]))
    assert list(tables(scan, [name, "NO_SUCH"])) == [name]
    chosen = scan.frames["system"] == 2
    part = tables(scan, chosen=chosen)
    assert sum(map(len, part.values())) == 30
    assert all((table["system"] == 2).all() for table in part.values())
    assert tables(scan, []) == {}


def test_unknown_messages_have_no_table() -> None:
    pen = Pen()
    pen.record(0)
    scan = scan_tlog(joined(mixed_records()))
    assert FOREIGN[0] in scan.frames["message_id"]
    assert set(tables(scan)) <= set(layouts_by_name())


def test_of_an_empty_log_there_are_none() -> None:
    assert tables(scan_tlog(b"")) == {}
