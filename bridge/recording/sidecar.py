"""The sidecar of a log, `run.tlog.json` beside `run.tlog`: its run, the link of each frame, and whether it is complete.

    complete   false from the beginning, true once the log was closed with every frame in it
    stamps     "simulation time" or "Unix time"; both in microseconds
    links      by number: uri, peer, and sent_by, the [system, component] whose frames were sent there; all other frames of
               the link were received. A recorder that only receives has no sent_by.
    index      with several links, the file that gives the link of each frame; else null

The stamps are left unchanged: MAVProxy writes a link number over their two low bits (3 is its own output), and pymavlink
reads those bits of any log as the link, so with our stamps its `_link` has no meaning. The index therefore has 8 bytes
(big endian) for each change of link: offset in the log << 8 | link. An entry is written before the frames that it applies
to, so that a process killed in between leaves no frame without its link.
"""

from __future__ import annotations

import importlib.metadata
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bridge.summary import read_json, write_json
from protocol.errors import RunFolderError

FORMAT = "fwav-hil log 1"
INDEX_ENTRY = struct.Struct(">Q")


class LinkOfLog(NamedTuple):
    """One link of a log: its URI, its peer if known, and the (system, component) of the senders on this end."""

    uri: str
    peer: str = ""
    sent_by: tuple[tuple[int, int], ...] = ()


def sidecar_path(log: Path) -> Path:
    """Path of the sidecar of a log."""
    return log.with_name(log.name + ".json")


def index_path(log: Path) -> Path:
    """Path of the link index, for a log with several links."""
    return log.with_name(log.name + ".links")


def new_sidecar(log: Path, links: tuple[LinkOfLog, ...], *, stamps: str, source: dict[str, Any]) -> dict[str, Any]:
    """The sidecar of a log that begins now; source describes the run: scenario, seed, clock mode ..."""
    return {
        "format": FORMAT,
        "complete": False,
        "log": log.name,
        "version": importlib.metadata.version("fwav-hil"),
        "pymavlink": importlib.metadata.version("pymavlink"),
        "stamps": stamps,
        **source,
        "links": [link._asdict() for link in links],
        "index": index_path(log).name if len(links) > 1 else None,
        "frames": None,
        "bytes": None,
        "lost": None,
        "error": None,
        "counters": {},
    }


def write_sidecar(log: Path, content: dict[str, Any]) -> None:
    """Write the sidecar atomically. Raises RunFolderError."""
    write_json(sidecar_path(log), content)


def read_sidecar(log: Path) -> dict[str, Any]:
    """The sidecar of a log; empty where it is missing, or is another program's file. Raises RunFolderError."""
    content = read_json(sidecar_path(log))
    return content if content.get("format") == FORMAT else {}


def link_numbers(log: Path, offsets: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """The link (n,) of the records that begin at these offsets (n,) of the log. Raises RunFolderError.

    All zeros where the log has only one link.
    """
    if not read_sidecar(log).get("index"):
        return np.zeros(len(offsets), dtype=np.uint8)
    path = index_path(log)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RunFolderError(f"cannot read the links of the log {path}: {error.strerror}") from None
    entries = np.frombuffer(data[: len(data) // INDEX_ENTRY.size * INDEX_ENTRY.size], dtype=">u8")
    places, numbers = (entries >> 8).astype(np.int64), (entries & 0xFF).astype(np.uint8)
    at = np.searchsorted(places, offsets, side="right") - 1
    return numbers[at] if len(numbers) else np.zeros(len(offsets), dtype=np.uint8)


def was_sent(sidecar: dict[str, Any], link: int, system: int, component: int) -> bool:
    """Whether the recorded program sent (and did not receive) the frames of that sender on that link."""
    links = sidecar.get("links", [])
    return link < len(links) and [system, component] in links[link]["sent_by"]
