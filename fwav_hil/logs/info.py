"""What is in a log, and what is missing or damaged: `fwav-hil log info`."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from bridge.recording.sidecar import link_numbers, read_sidecar
from fwav_hil.logs.choice import duration
from fwav_hil.tables import plain_console
from protocol.errors import RunFolderError
from protocol.logs.dialect import layouts
from protocol.logs.files import Log
from protocol.logs.scan import Scan
from protocol.logs.sequences import count_losses

GAP = 3.0
"""An interval longer than this many times the usual (median) one is a gap."""

PLACES_SHOWN = 20
_JUMP_AHEAD_US, _JUMP_BACK_US = 86_400_000_000, 60_000_000
_WIDTH_ELSEWHERE = 120
"""Columns where there is no terminal: no name is cut off."""
_SHOWN_INFORMATION = ("sys_name", "ver_hw", "ver_sw", "ver_sw_branch", "replay")
_YEAR_2000_S = 946_684_800.0


def log_info(log: Log) -> dict[str, Any]:
    """All that `log info` says, as plain values; times in seconds.

    kind, bytes, start_s (of the first record), duration_s, clock_jumps (after_s and by_s of each step of the stamps by more
    than a day, or a minute back), messages, rate_hz; systems (MAVLink logs: system, component, messages, lost,
    out_of_order, versions, signed); types (name, system, component, count, rate_hz, interval_s: the median, gaps,
    longest_gap_s); recording (of a log of this project, by its sidecar: complete, lost, error, stamps, links: uri, peer,
    sent and received frames); content (of a PX4 log: how many topics, logged_messages, parameters and so on, and its
    information by key); damage (counters, and places: offset and bytes of the first stretches of damage).
    """
    first, last = log.span_us()
    count = len(log.scan) if log.scan is not None else sum(map(len, log.records.values()))
    duration_s = (last - first) / 1e6
    return {
        "log": str(log.path),
        "kind": log.kind,
        "bytes": log.path.stat().st_size,
        "start_s": first / 1e6,
        "duration_s": duration_s,
        "clock_jumps": _clock_jumps(log.scan) if log.scan is not None else [],
        "messages": count,
        "rate_hz": (count - 1) / duration_s if duration_s > 0 else None,
        "systems": _systems(log.scan) if log.scan is not None else [],
        "types": _types_of_scan(log.scan) if log.scan is not None else _types_of_tables(log),
        "recording": _recording(log),
        "content": dict(log.said),
        "damage": dict(log.counters) | ({"places": _places(log.scan)} if log.scan is not None else {}),
    }


def _recording(log: Log) -> dict[str, Any] | None:
    """What the sidecar beside a log says of it; None where there is none, or it cannot be read."""
    try:
        sidecar = read_sidecar(log.path)
        if not sidecar or log.scan is None:
            return None
        frames = log.scan.frames
        numbers = link_numbers(log.path, frames["offset"] - log.scan.stamp_size)
    except RunFolderError:
        return None
    links = []
    for number, link in enumerate(sidecar["links"]):
        here = frames[numbers == number]
        sent = sum(
            int(np.count_nonzero((here["system"] == system) & (here["component"] == component)))
            for system, component in link["sent_by"]
        )
        links.append({"uri": link["uri"], "peer": link["peer"], "sent": sent, "received": len(here) - sent})
    said = {
        key: sidecar.get(key) for key in ("version", "scenario", "seed", "clock", "stamps", "complete", "lost", "error")
    }
    return said | {"links": links}


def _systems(scan: Scan) -> list[dict[str, Any]]:
    rows = []
    for (system, component), (lost, out_of_order) in count_losses(scan).items():
        frames = scan.frames[(scan.frames["system"] == system) & (scan.frames["component"] == component)]
        rows.append(
            {
                "system": system,
                "component": component,
                "messages": len(frames),
                "lost": lost,
                "out_of_order": out_of_order,
                "versions": [int(version) for version in np.unique(frames["version"])],
                "signed": int(np.count_nonzero(frames["signed"])),
            }
        )
    return rows


def _types_of_scan(scan: Scan) -> list[dict[str, Any]]:
    """One row for each message of each sender, in order of names."""
    frames = scan.frames
    key = frames["message_id"].astype(np.int64) << 16 | frames["system"].astype(np.int64) << 8 | frames["component"]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    rows = []
    for start, end in zip(starts, [*starts[1:], len(order)], strict=True):
        frame = frames[order[start]]
        number = int(frame["message_id"])
        name = layouts()[number].name if frame["known"] else f"UNKNOWN_{number}"
        sender = {"system": int(frame["system"]), "component": int(frame["component"])}
        rows.append({"name": name, **sender} | _pace(frames["stamp_us"][order[start:end]]))
    return sorted(rows, key=lambda row: (row["name"], row["system"], row["component"]))


def _types_of_tables(log: Log) -> list[dict[str, Any]]:
    return [
        {"name": name, "system": None, "component": None} | _pace(table.t_us) for name, table in log.records.items()
    ]


def _pace(stamps_us: npt.NDArray[np.int64]) -> dict[str, Any]:
    """Count, rate and gaps of records at these times."""
    intervals = np.diff(stamps_us) / 1e6
    usual = float(np.median(intervals)) if len(intervals) else None
    span = float(intervals.sum())
    return {
        "count": len(stamps_us),
        "rate_hz": len(intervals) / span if span > 0 else None,
        "interval_s": usual,
        "gaps": int(np.count_nonzero(intervals > GAP * usual)) if usual else 0,
        "longest_gap_s": float(intervals.max()) if len(intervals) else None,
    }


def _clock_jumps(scan: Scan) -> list[dict[str, float]]:
    """Where the clock of the computer that recorded was set: seconds since the log began, and by how many it jumped."""
    stamps = scan.frames["stamp_us"]
    steps = np.diff(stamps)
    where = np.flatnonzero((steps > _JUMP_AHEAD_US) | (steps < -_JUMP_BACK_US))[:PLACES_SHOWN]
    return [{"after_s": float(stamps[at] - stamps[0]) / 1e6, "by_s": float(steps[at]) / 1e6} for at in where]


def _places(scan: Scan) -> list[dict[str, int]]:
    """The first stretches of bytes between records that belong to none."""
    begins = scan.frames["offset"].astype(np.int64) - scan.stamp_size
    ends = np.concatenate([[0], scan.ends()])
    sizes = np.append(begins, len(scan.data)) - ends
    where = np.flatnonzero(sizes > 0)[:PLACES_SHOWN]
    return [{"offset": int(ends[at]), "bytes": int(sizes[at])} for at in where]


def print_info(info: dict[str, Any], *, to_stderr: bool = False) -> None:
    """Print what `log_info` gives."""
    stream = sys.stderr if to_stderr else sys.stdout
    console = plain_console(to_stderr=to_stderr, width=None if stream.isatty() else _WIDTH_ELSEWHERE)
    rate = f", {info['rate_hz']:.0f} a second" if info["rate_hz"] else ""
    console.print(f"{info['log']}: {info['kind']}, {info['bytes']} bytes")
    console.print(
        f"{info['messages']} messages in {info['duration_s']:.3f} s{rate}, from {_moment(info['start_s'])} on"
    )
    for jump in info["clock_jumps"]:
        way = "ahead" if jump["by_s"] > 0 else "back"
        console.print(f"the log's clock jumps {way} by {duration(abs(jump['by_s']))} after {jump['after_s']:.3f} s")
    if info["recording"]:
        _print_recording(console, info["recording"])
    if info["content"]:
        _print_content(console, info["content"])
    if info["systems"]:
        console.print(_systems_table(info["systems"]))
    console.print(_types_table(info["types"]))
    damage = {name: value for name, value in info["damage"].items() if value and name != "places"}
    console.print("damage: " + (", ".join(f"{name} {value}" for name, value in damage.items()) or "none"))
    places = info["damage"].get("places", [])
    if places:
        shown = ", ".join(f"{place['offset']} ({place['bytes']})" for place in places)
        console.print(f"at byte (bytes): {shown}" + (" ..." if len(places) == PLACES_SHOWN else ""))


def _print_recording(console: Console, recording: dict[str, Any]) -> None:
    """What the sidecar adds to a log: whether it is whole, and the links."""
    whole = "complete" if recording["complete"] else "not complete: it was cut short, or is still being written"
    if recording["lost"]:
        whole = f"not complete: {recording['lost']} frames are missing ({recording['error']})"
    scenario = f" of {recording['scenario']}" if recording["scenario"] else ""
    console.print(f"recorded by fwav-hil {recording['version']}{scenario}, {whole}; stamps are {recording['stamps']}")
    for link in recording["links"]:
        peer = f" ({link['peer']})" if link["peer"] else ""
        console.print(f"link {link['uri']}{peer}: {link['sent']} frames sent, {link['received']} received")


def _print_content(console: Console, content: dict[str, Any]) -> None:
    """What a PX4 log holds besides, and which system it is of."""
    counts = {"topics": 0, "logged_messages": 0, "parameters": 0} | {
        name: value for name, value in content.items() if name != "information"
    }
    console.print(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()))
    said = [f"{key} {content['information'][key]}" for key in _SHOWN_INFORMATION if key in content["information"]]
    if said:
        console.print(", ".join(said))


def _moment(t_s: float) -> str:
    """A date where the stamps are dates, else the time that they count."""
    if t_s < _YEAR_2000_S:
        return f"t = {t_s:.6f} s"
    return str(np.datetime64(round(1e3 * t_s), "ms")).replace("T", " ") + " UTC"


def _systems_table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="senders", title_justify="left")
    for column in ("system", "component", "messages", "lost", "out of order", "MAVLink", "signed"):
        table.add_column(column, justify="right")
    for row in rows:
        versions = ", ".join(map(str, row["versions"]))
        signed = "no" if not row["signed"] else "yes" if row["signed"] == row["messages"] else str(row["signed"])
        cells = (row[name] for name in ("system", "component", "messages", "lost", "out_of_order"))
        table.add_row(*map(str, cells), versions, signed)
    return table


def _types_table(rows: list[dict[str, Any]]) -> Table:
    table = Table("message", title="messages", title_justify="left")
    for column in ("from", "count", "rate", "gaps", "longest"):
        table.add_column(column, justify="right")
    for row in rows:
        sender = f"{row['system']}.{row['component']}" if row["system"] is not None else ""
        rate = f"{row['rate_hz']:.4g} Hz" if row["rate_hz"] else "-"
        longest = f"{row['longest_gap_s']:.4g} s" if row["longest_gap_s"] is not None else "-"
        table.add_row(row["name"], sender, str(row["count"]), rate, str(row["gaps"]), longest)
    return table
