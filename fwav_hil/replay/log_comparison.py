"""Two logs compared, sample by sample: rows of a message from one sender are paired by the time that the message carries.

A message without a time (HEARTBEAT) is paired by its position in the order. Times since 1970 count from the first in each log.
Frame sequence numbers and the record time stamps are not compared: they describe the link, not the flight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.errors import UsageError
from protocol.logs.dialect import layouts_by_name
from protocol.logs.retime import UNIX_FROM_US
from protocol.logs.scan import Scan
from protocol.logs.tables import HEAD, tables

_TIME_FIELDS = (("time_usec", 1), ("time_boot_us", 1), ("time_boot_ms", 1000))
_HEAD = {name for name, _ in HEAD}

Table = npt.NDArray[np.void]
Times = npt.NDArray[np.int64]


class Tolerances:
    """How far two values may differ and still count as the same: by MESSAGE.field, by field, or for all other fields."""

    def __init__(self, default: float = 0.0, fields: Mapping[str, float] | None = None) -> None:
        self.default = default
        self._fields = dict(fields or {})

    def of(self, message: str, field: str) -> float:
        """The tolerance of one field."""
        return self._fields.get(f"{message}.{field}", self._fields.get(field, self.default))


def parse_tolerances(texts: Sequence[str]) -> Tolerances:
    """Tolerances from `FIELD=VALUE`, `MESSAGE.FIELD=VALUE` or, for all others, `VALUE`. Raises UsageError."""
    default, fields = 0.0, {}
    for text in texts:
        name, separator, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = -1.0
        if not value >= 0.0:
            raise UsageError(
                f"--tolerance {text} is not valid: write FIELD=VALUE, MESSAGE.FIELD=VALUE, or one VALUE for the rest"
            )
        if not separator:
            default = value
        else:
            _refuse_unknown(name)
            fields[name] = value
    return Tolerances(default, fields)


def _refuse_unknown(name: str) -> None:
    message, separator, field = name.rpartition(".")
    known = layouts_by_name()
    if separator and message not in known:
        raise UsageError(f"--tolerance {name}: there is no message {message}: `fwav-hil log info` lists those of a log")
    candidates = [known[message]] if separator else list(known.values())
    if not any(field in candidate.fields for candidate in candidates):
        raise UsageError(f"--tolerance {name}: there is no field {field}: use a field of the messages")


class FieldDifference(NamedTuple):
    """One field of one message from one sender. first_s: time of the first pair beyond the tolerance, else None.

    changed    pairs that are not equal     beyond     pairs that differ by more than the tolerance
    """

    message: str
    sender: str
    field: str
    tolerance: float
    pairs: int
    changed: int
    beyond: int
    largest: float
    rms: float
    first_s: float | None


class LogDifference(NamedTuple):
    """fields: every field compared; only_first, only_second: rows without a partner, by "MESSAGE system/component"."""

    fields: list[FieldDifference]
    only_first: dict[str, int]
    only_second: dict[str, int]

    @property
    def is_same(self) -> bool:
        """Whether every row has a partner within the tolerances; False where there are no rows."""
        paired = any(field.pairs for field in self.fields)
        return paired and not (self.only_first or self.only_second or any(field.beyond for field in self.fields))

    def as_dict(self) -> dict[str, Any]:
        """The result for JSON."""
        return {
            "same": self.is_same,
            "fields": [field._asdict() for field in self.fields],
            "only_first": self.only_first,
            "only_second": self.only_second,
        }


def compare_logs(
    first: Scan, second: Scan, tolerances: Tolerances, types: Sequence[str] | None = None
) -> LogDifference:
    """Compare two logs, or only some of their messages."""
    groups = [_by_sender(tables(scan, types)) for scan in (first, second)]
    fields: list[FieldDifference] = []
    only: tuple[dict[str, int], dict[str, int]] = ({}, {})
    for key in sorted(groups[0].keys() | groups[1].keys()):
        message, sender = key
        pair = [group.get(key) for group in groups]
        empty = np.zeros(0, dtype=next(table.dtype for table in pair if table is not None))
        one, two = (empty if table is None else table for table in pair)
        here, there = _pair(_times_us(one), _times_us(two))
        for rows, partners, missing in ((one, here, only[0]), (two, there, only[1])):
            if len(rows) > len(partners):
                missing[f"{message} {sender}"] = len(rows) - len(partners)
        if len(here):
            times_us = _times_us(one)[here]
            fields += _compare_fields(message, sender, one[here], two[there], times_us, tolerances)
    _compare_unknown(first, second, types, fields, only)
    return LogDifference(fields, *only)


def _compare_unknown(
    first: Scan,
    second: Scan,
    types: Sequence[str] | None,
    fields: list[FieldDifference],
    only: tuple[dict[str, int], dict[str, int]],
) -> None:
    """Frames of messages that the dialect lacks: paired by their order, payloads compared as a whole."""
    groups = [_unknown_by_sender(scan) for scan in (first, second)]
    for message, sender in sorted(groups[0].keys() | groups[1].keys()):
        if types and message not in types:
            continue
        one, two = (group.get((message, sender), []) for group in groups)
        for rows, others, missing in ((one, two, only[0]), (two, one, only[1])):
            if len(rows) > len(others):
                missing[f"{message} {sender}"] = len(rows) - len(others)
        pairs = list(zip(one, two, strict=False))
        if pairs:
            apart = [row for row, (a, b) in enumerate(pairs) if first.payload(a) != second.payload(b)]
            first_s = float(first.frames["stamp_us"][pairs[apart[0]][0]]) * 1e-6 if apart else None
            largest = float("inf") if apart else 0.0
            fields.append(
                FieldDifference(
                    message, sender, "payload", 0.0, len(pairs), len(apart), len(apart), largest, largest, first_s
                )
            )


def _unknown_by_sender(scan: Scan) -> dict[tuple[str, str], list[int]]:
    rows: dict[tuple[str, str], list[int]] = {}
    for row in np.flatnonzero(scan.frames["known"] == 0).tolist():
        frame = scan.frames[row]
        key = f"UNKNOWN_{frame['message_id']}", f"{frame['system']}/{frame['component']}"
        rows.setdefault(key, []).append(row)
    return rows


def _by_sender(by_message: Mapping[str, Table]) -> dict[tuple[str, str], Table]:
    groups = {}
    for message, table in by_message.items():
        senders = table["system"].astype(np.int64) << 8 | table["component"]
        for sender in np.unique(senders):
            groups[message, f"{sender >> 8}/{sender & 0xFF}"] = table[senders == sender]
    return groups


def _times_us(table: Table) -> Times:
    """The key by which rows are paired: the time in the message, or its position."""
    for field, unit in _TIME_FIELDS:
        if field in (table.dtype.names or ()):
            times: Times = table[field].astype(np.int64) * unit
            unix = times >= UNIX_FROM_US
            return np.where(unix, times - times[unix].min(), times) if unix.any() else times
    return np.arange(len(table), dtype=np.int64)


def _pair(one: Times, two: Times) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows of both that have the same time; of several at one time, the first goes with the first, and so on."""
    _, ranks = np.unique(np.concatenate((one, two)), return_inverse=True)
    numbered = [_numbered(part) for part in np.split(ranks.ravel(), [len(one)])]
    most = 1 + max((int(part.max()) for part in numbered if len(part)), default=0)
    first, second = (
        part + most * rank for part, rank in zip(numbered, np.split(ranks.ravel(), [len(one)]), strict=True)
    )
    _, here, there = np.intersect1d(first, second, assume_unique=True, return_indices=True)
    return here, there


def _numbered(ranks: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """For each row, the number of earlier rows of the same rank."""
    order = np.argsort(ranks, kind="stable")
    sorted_ranks = ranks[order]
    starts = np.searchsorted(sorted_ranks, sorted_ranks)
    numbers = np.empty_like(order)
    numbers[order] = np.arange(len(ranks)) - starts
    return numbers


def _compare_fields(
    message: str, sender: str, one: Table, two: Table, times_us: Times, tolerances: Tolerances
) -> list[FieldDifference]:
    timed = any(field in (one.dtype.names or ()) for field, _ in _TIME_FIELDS)
    found = []
    for field in one.dtype.names or ():
        if field in _HEAD or (field in {name for name, _ in _TIME_FIELDS} and timed):
            continue
        apart = _apart(one[field], two[field])
        tolerance = tolerances.of(message, field)
        beyond = np.flatnonzero(~(apart <= tolerance))
        finite = apart[np.isfinite(apart)]
        found.append(
            FieldDifference(
                message=message,
                sender=sender,
                field=field,
                tolerance=tolerance,
                pairs=len(apart),
                changed=int(np.count_nonzero(apart)),
                beyond=len(beyond),
                largest=float(apart.max()),
                rms=float(np.sqrt(np.mean(finite**2))) if len(finite) else float("inf"),
                first_s=float((times_us if timed else one["t_us"])[beyond[0]]) * 1e-6 if len(beyond) else None,
            )
        )
    return found


def _apart(one: npt.NDArray[Any], two: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """The differences of the values (n,) or (n, k) of row pairs, the largest of each row; infinite for unequal texts."""
    if one.dtype.kind == "S":
        return np.where(one == two, 0.0, np.inf)
    if one.dtype.kind == "f":
        a, b = one.astype(float), two.astype(float)
        with np.errstate(invalid="ignore", over="ignore"):
            apart = np.abs(a - b)
        same = (a == b) | (np.isnan(a) & np.isnan(b))
        apart = np.where(same, 0.0, np.where(np.isnan(apart), np.inf, apart))
    else:
        # As unsigned 64-bit numbers, larger minus smaller is right for every integer type.
        a, b = (
            column.astype(np.int64 if column.dtype.kind == "i" else np.uint64).view(np.uint64) for column in (one, two)
        )
        apart = np.where(one >= two, a - b, b - a).astype(float)
    largest: npt.NDArray[np.float64] = apart.reshape(len(apart), -1).max(axis=1)
    return largest
