"""A log as tables: one structured array for each message, fields by name, in the order of the log.

    tables(scan)["HIL_SENSOR"]["xacc"]          # float32, shape (rows,)
    tables(scan)["ATT_POS_MOCAP"]["q"]          # float32, shape (rows, 4)

Each table begins with the columns t_us (time of the record), system, component and frame_sequence; those of the message
follow in wire order, with pymavlink's types. A payload whose trailing zeros were cut off is filled up with them.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from protocol.logs.dialect import BINARY, layouts, layouts_by_name, of_dialect
from protocol.logs.names import distinct
from protocol.logs.record_table import RESERVED
from protocol.logs.records import IDS, State
from protocol.logs.rows import count_rows, fill_rows
from protocol.logs.scan import Scan
from protocol.wire.codec import Layout
from protocol.wire.framing import Table

HEAD = (("t_us", "<i8"), ("system", "u1"), ("component", "u1"), ("frame_sequence", "u1"))
"""The columns that every table of a MAVLink log begins with. No message has a field of these names (a test holds it)."""

Tables = dict[str, npt.NDArray[np.void]]


@of_dialect
def table_dtype(name: str) -> np.dtype[np.void]:
    """Row of the table of a message. Raises KeyError where the dialect has none of that name."""
    fields = layouts_by_name()[name].dtype
    own = fields.names or ()
    columns = distinct(own, [*(head for head, _ in HEAD), *RESERVED])
    kinds = (
        (column, f"V{fields[field].itemsize}" if (name, field) in BINARY else fields[field])
        for column, field in zip(columns, own, strict=True)
    )
    return np.dtype([*HEAD, *kinds])


def tables(scan: Scan, names: Collection[str] | None = None, chosen: npt.NDArray[np.bool_] | None = None) -> Tables:
    """The table of each message in the log, by name, in order of id; of those `names`, and rows `chosen`, only.

    `chosen` has one truth value for each row of `scan.frames`. The tables share one piece of memory.
    """
    wanted, numbers, slots, counts, mask = _counted(scan, names, chosen)
    sizes = np.array([wanted[number].size for number in numbers], dtype=np.int64)
    head = np.dtype(list(HEAD)).itemsize
    ends = np.cumsum(counts * (sizes + head))
    starts = ends - counts * (sizes + head)
    rows = np.zeros(int(ends[-1]) if len(ends) else 0, dtype=np.uint8)
    fill_rows(scan.data, scan.frames, mask, slots, starts.copy(), sizes, head, rows)
    return {
        wanted[number].name: rows[start:end].view(table_dtype(wanted[number].name))
        for number, start, end in zip(numbers, starts, ends, strict=True)
        if end > start
    }


def row_counts(
    scan: Scan, names: Collection[str] | None = None, chosen: npt.NDArray[np.bool_] | None = None
) -> dict[str, int]:
    """How many rows each of the tables has that `tables` gives."""
    wanted, numbers, _, counts, _ = _counted(scan, names, chosen)
    return {wanted[number].name: count for number, count in zip(numbers, counts.tolist(), strict=True) if count}


def _counted(
    scan: Scan, names: Collection[str] | None, chosen: npt.NDArray[np.bool_] | None
) -> tuple[dict[int, Layout], list[int], Table, State, npt.NDArray[np.uint8]]:
    """The wanted messages, their ids in order, the slot of each id, the rows of each slot, and the rows chosen."""
    wanted = {number: message for number, message in layouts().items() if names is None or message.name in names}
    numbers = sorted(wanted)
    slots = np.zeros(IDS, dtype=np.int32)
    slots[numbers] = np.arange(1, len(numbers) + 1)
    counts = np.zeros(len(numbers), dtype=np.int64)
    mask = np.zeros(0, dtype=np.uint8) if chosen is None else chosen.view(np.uint8)
    count_rows(scan.frames, mask, slots, counts)
    return wanted, numbers, slots, counts, mask
