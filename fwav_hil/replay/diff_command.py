"""The command line of `fwav-hil diff`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bridge.option_types import EXISTING
from bridge.options import Argument, Option, command
from bridge.shared_options import JsonPath
from bridge.summary import is_stdout, show_json
from fwav_hil.logs.dialect_option import Dialect

if TYPE_CHECKING:
    from fwav_hil.replay.log_comparison import LogDifference

_SHOWN_ROWS = 30
ExistingLog = Annotated[Path, Argument(type=EXISTING)]


@command(
    "diff",
    "fwav-hil diff runs/before runs/after",
    "fwav-hil diff a.tlog b.tlog --types ATT_POS_MOCAP --tolerance q=1e-6 --tolerance HIL_SENSOR.xacc=0.01 --tolerance 1e-5",
)
def diff_command(
    first: ExistingLog,
    second: ExistingLog,
    tolerances: Annotated[tuple[str, ...], Option(
        "--tolerance", "Allowed difference of a field (FIELD, or MESSAGE.FIELD); without FIELD, of all others. Default: 0.",
        "[FIELD=]VALUE"
    )] = (),
    types: Annotated[tuple[str, ...], Option("--types", "Compare only these messages.", "NAME,...")] = (),
    dialect: Dialect = None,
    json_path: JsonPath = None,
) -> int:  # fmt: skip
    """Compare two logs (or run folders): rows are paired by the sample time that their messages carry.

    \b
    Exit codes: 0 the same within the tolerances, 1 different; others as for every command.
    """
    from fwav_hil.logs.choice import held_names, names_in, open_telemetry
    from fwav_hil.replay.command import DIFFERENT
    from fwav_hil.replay.log_comparison import compare_logs, parse_tolerances

    allowed = parse_tolerances(tolerances)
    (one, first_scan), (two, second_scan) = open_telemetry(first), open_telemetry(second)
    names = held_names(
        types, {**dict.fromkeys(names_in(one)), **dict.fromkeys(names_in(two))}, f"{one.path} or {two.path}"
    )
    difference = compare_logs(first_scan, second_scan, allowed, names or None)
    _print(difference, to_stderr=is_stdout(json_path))
    show_json(json_path, {"first": str(one.path), "second": str(two.path), **difference.as_dict()})
    return 0 if difference.is_same else DIFFERENT


def _print(difference: LogDifference, *, to_stderr: bool) -> None:
    """The fields beyond their tolerances, in the order in which they part, and what has no partner."""
    from rich.table import Table

    from fwav_hil.tables import plain_console

    stream = sys.stderr if to_stderr else sys.stdout
    width = None if stream.isatty() else 120  # no name is cut off in a file
    console = plain_console(to_stderr=to_stderr, width=width)
    beyond = sorted((f for f in difference.fields if f.beyond), key=lambda f: (f.first_s or 0.0, f.message, f.field))
    if beyond:
        table = Table("field", "sender")
        for column in ("pairs", "beyond", "largest", "RMS", "first (s)"):
            table.add_column(column, justify="right")
        for f in beyond[:_SHOWN_ROWS]:
            numbers = (str(f.pairs), str(f.beyond), f"{f.largest:.3g}", f"{f.rms:.3g}", f"{f.first_s:.3f}")
            table.add_row(f"{f.message}.{f.field}", f.sender, *numbers)
        console.print(table)
        if len(beyond) > _SHOWN_ROWS:
            console.print(f"and {len(beyond) - _SHOWN_ROWS} more fields (--json has all)")
    for name, rows in (("first", difference.only_first), ("second", difference.only_second)):
        for what, count in rows.items():
            console.print(f"only in the {name}: {count} of {what}")
    changed = sum(1 for f in difference.fields if f.changed)
    pairs = sum(f.pairs for f in difference.fields)
    if difference.is_same:
        words = "identical" if not changed else f"the same within the tolerances ({changed} fields differ by less)"
        console.print(f"{words}: {len(difference.fields)} fields, {pairs} values compared")
    else:
        alone = sum(difference.only_first.values()) + sum(difference.only_second.values())
        partnerless = f", {alone} rows without a partner" if alone else ""
        console.print(f"different: {len(beyond)} of {len(difference.fields)} fields{partnerless}")
