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

import numpy as np
import numpy.typing as npt

from fwav_hil.logs.choice import Choice
from fwav_hil.logs.outputs import file_names, whole
from fwav_hil.logs.working import Working
from protocol.logs.files import Log, fields_of, plain

SUFFIXES = {"parquet": "_parquet", "csv": "_csv", "mcap": ".mcap"}
_ROWS_AT_ONCE = 1 << 17


def default_output(log: Path, kind: str) -> Path:
    """Where an export goes that was not told: beside nothing, in the folder one is in."""
    return Path(log.stem + SUFFIXES[kind])


def export_log(log: Log, kind: str, out: Path, choice: Choice) -> dict[str, Any]:
    """Write the log to `out`, which must not be there yet: a file for mcap, else a folder.

    Returns out, files and messages (counts by name). Raises RunFolderError.
    """
    if kind == "mcap":
        from fwav_hil.logs.mcap_file import write_mcap

        with whole(out) as partial, Working(f"writing {out.name}") as working:
            return {"out": str(out), "files": [out.name], "messages": write_mcap(log, partial, choice, working)}
    made = log.tables(choice.names, between_us=choice.between_us, senders=choice.senders)
    write: Callable[[str, npt.NDArray[np.void], Path, Callable[[int], None]], None] = (
        _write_parquet if kind == "parquet" else _write_csv
    )
    total = sum(map(len, made.values()))
    files = {name: f"{safe}.{kind}" for name, safe in file_names(made).items()}
    with whole(out) as partial, Working(f"writing {out.name}") as working:
        partial.mkdir()
        before = 0
        for name, table in made.items():
            write(name, table, partial / files[name], lambda rows, before=before: working(before + rows, total))  # type: ignore[misc]
            before += len(table)
    return {
        "out": str(out),
        "files": list(files.values()),
        "messages": {name: len(table) for name, table in made.items()},
    }


def _chunks(table: npt.NDArray[np.void]) -> Iterator[npt.NDArray[np.void]]:
    for start in range(0, len(table), _ROWS_AT_ONCE):
        yield table[start : start + _ROWS_AT_ONCE]


def _head(table: npt.NDArray[np.void]) -> list[str]:
    return ["system", "component", "frame_sequence"] if "frame_sequence" in (table.dtype.names or ()) else []


def _write_parquet(name: str, table: npt.NDArray[np.void], path: Path, told: Callable[[int], None]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = ["t_us", *_head(table), *fields_of(table)]
    first = _arrow({column: table[column][:0] for column in columns})
    with pq.ParquetWriter(path, first.schema.with_metadata({"message": name})) as writer:
        for number, rows in enumerate(_chunks(table)):
            part = _arrow({column: rows[column] for column in columns})
            writer.write_table(pa.Table.from_arrays(part.columns, schema=writer.schema))
            told(min(len(table), (number + 1) * _ROWS_AT_ONCE))


def _arrow(columns: dict[str, npt.NDArray[Any]]) -> Any:
    import pyarrow as pa

    made = {}
    for name, column in columns.items():
        if column.dtype.kind == "S":
            made[name] = pa.array(plain(column), type=pa.string())
        elif column.ndim > 1:
            flat = pa.array(np.ascontiguousarray(column).reshape(-1))
            made[name] = pa.FixedSizeListArray.from_arrays(flat, column.shape[1])
        else:
            made[name] = pa.array(np.ascontiguousarray(column))
    return pa.table(made)


def _write_csv(name: str, table: npt.NDArray[np.void], path: Path, told: Callable[[int], None]) -> None:
    import pyarrow.csv as arrow_csv

    writer = None
    for number, rows in enumerate(_chunks(table)):
        columns: dict[str, npt.NDArray[Any]] = {"time_s": rows["t_us"] / 1e6}
        columns |= {column: rows[column] for column in _head(table)}
        for field in fields_of(table):
            value = rows[field]
            if value.ndim > 1:
                columns |= {f"{field}[{element}]": value[:, element] for element in range(value.shape[1])}
            else:
                columns[field] = value
        part = _without_nan(_arrow(columns))
        writer = writer or arrow_csv.CSVWriter(path, part.schema)
        writer.write_table(part)
        told(min(len(table), (number + 1) * _ROWS_AT_ONCE))
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
