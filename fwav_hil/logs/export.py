"""A log as Parquet, CSV or MCAP for other programs: `fwav-hil log export`.

    parquet   one file for each message; t_us, sender and fields as columns with their own types, arrays as lists
    csv       one file for each message; time_s first, then sender and fields, arrays as field[0], field[1] ...
    mcap      one file; a topic for each message of each sender, JSON with a JSON Schema, which Foxglove and PlotJuggler read

What is written has its final name only once it is whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from fwav_hil.logs.choice import Choice
from fwav_hil.logs.outputs import file_names, whole
from fwav_hil.logs.working import Working
from protocol.logs.files import Log, chosen_rows, fields_of, plain
from protocol.logs.record_table import Unit

SUFFIXES = {"parquet": "_parquet", "csv": "_csv", "mcap": ".mcap"}
UNITS = "units.json"
"""Beside CSV files, which cannot hold units: those that the log itself says, by message and field."""
_ROWS_AT_ONCE = 1 << 17
Pieces = Iterator[npt.NDArray[np.void]]


def default_output(log: Path, kind: str) -> Path:
    """Where an export goes that was not told: beside nothing, in the folder one is in."""
    return Path(log.stem + SUFFIXES[kind])


def export_log(log: Log, kind: str, out: Path, choice: Choice) -> dict[str, Any]:
    """Write the log to `out`, which must not be there yet: a file for mcap, else a folder.

    Returns out, files, messages (counts by name) and unknown_frames (of the chosen, those that no export can hold). Of a
    message no more than a piece is in memory at once. Raises RunFolderError.
    """
    unknown = {"unknown_frames": unknown_frames(log, choice)}
    if kind == "mcap":
        from fwav_hil.logs.mcap_file import write_mcap

        with whole(out) as partial, Working(f"writing {out.name}") as working:
            counts = write_mcap(log, partial, choice, working)
            return {"out": str(out), "files": [out.name], "messages": counts, **unknown}
    counts = log.counts(choice.names, between_us=choice.between_us, senders=choice.senders)
    write: Callable[[Log, str, Path, Pieces], None] = _write_parquet if kind == "parquet" else _write_csv
    files = {name: f"{safe}.{kind}" for name, safe in file_names(counts, [Path(UNITS).stem]).items()}
    units = {name: found for name in counts if (found := _units(log, name))}
    with whole(out) as partial, Working(f"writing {out.name}") as working:
        partial.mkdir()
        before, total = 0, sum(counts.values())
        for name, count in counts.items():
            pieces = log.pieces(name, _ROWS_AT_ONCE, between_us=choice.between_us, senders=choice.senders)
            write(log, name, partial / files[name], _told(pieces, before, total, working))
            before += count
        if units and kind == "csv":
            (partial / UNITS).write_bytes(msgspec.json.format(msgspec.json.encode(units)))
    return {"out": str(out), "files": list(files.values()), "messages": counts, **unknown}


def unknown_frames(log: Log, choice: Choice) -> int:
    """How many of the chosen frames are of messages that the dialect lacks, so that nothing says what is in them."""
    if log.scan is None or choice.names is not None:
        return 0
    rows = chosen_rows(log.scan, choice.between_us, choice.senders)
    unknown = log.scan.frames["known"] == 0
    return int(np.count_nonzero(unknown if rows is None else unknown & rows))


def _told(pieces: Pieces, before: int, total: int, working: Working) -> Pieces:
    for piece in pieces:
        yield piece
        before += len(piece)
        working(before, total)


def _units(log: Log, name: str) -> dict[str, dict[str, Any]]:
    """The units of a message of a log that says them itself, by field."""
    table = log.records.get(name)
    return {field: unit._asdict() for field, unit in table.units.items()} if table else {}


def _head(table: npt.NDArray[np.void]) -> list[str]:
    return ["system", "component", "frame_sequence"] if "frame_sequence" in (table.dtype.names or ()) else []


def _write_parquet(log: Log, name: str, path: Path, pieces: Pieces) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    writer = None
    for rows in pieces:
        columns = ["t_us", *_head(rows), *fields_of(rows)]
        part = _arrow({column: rows[column] for column in columns})
        if writer is None:
            fields = [_with_unit(field, log.unit(name, field.name)) for field in part.schema]
            writer = pq.ParquetWriter(path, pa.schema(fields, metadata={"message": name}))
        writer.write_table(pa.Table.from_arrays(part.columns, schema=writer.schema))
    if writer is not None:
        writer.close()


def _with_unit(field: Any, unit: Unit) -> Any:
    return field.with_metadata({"unit": unit.name, "multiplier": repr(unit.multiplier)}) if unit.name else field


def _arrow(columns: dict[str, npt.NDArray[Any]]) -> Any:
    import pyarrow as pa

    made = {}
    for name, column in columns.items():
        if column.dtype.kind in "SO":
            made[name] = pa.array(plain(column), type=pa.string())
        elif column.dtype.kind == "V":
            made[name] = pa.array(column.tolist(), type=pa.binary(column.dtype.itemsize))
        elif column.ndim > 1:
            flat = pa.array(np.ascontiguousarray(column).reshape(-1))
            made[name] = pa.FixedSizeListArray.from_arrays(flat, column.shape[1])
        else:
            made[name] = pa.array(np.ascontiguousarray(column))
    return pa.table(made)


def _write_csv(_log: Log, _name: str, path: Path, pieces: Pieces) -> None:
    import pyarrow.csv as arrow_csv

    writer = None
    for rows in pieces:
        columns: dict[str, npt.NDArray[Any]] = {"time_s": rows["t_us"] / 1e6}
        columns |= {column: rows[column] for column in _head(rows)}
        for field in fields_of(rows):
            value = rows[field]
            if value.ndim > 1:
                columns |= {f"{field}[{element}]": value[:, element] for element in range(value.shape[1])}
            elif value.dtype.kind == "V":
                columns[field] = np.array(plain(value), dtype=f"S{2 * value.dtype.itemsize}")
            else:
                columns[field] = value
        part = _without_nan(_arrow(columns))
        writer = writer or arrow_csv.CSVWriter(path, part.schema)
        writer.write_table(part)
    if writer:
        writer.close()


def _without_nan(table: Any) -> Any:
    """NaN as an empty cell, which is what programs that read CSV take for no value."""
    import pyarrow as pa
    import pyarrow.compute as pc

    columns = [
        pc.if_else(pc.is_nan(column), None, column) if pa.types.is_floating(column.type) else column
        for column in table.columns
    ]
    return pa.table(columns, schema=table.schema)
