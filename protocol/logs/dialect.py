"""The messages that logs are read with: pymavlink's `all` dialect, the widest there is, unless `choose` names another.

Two dialects, matrixpilot and paparazzi, use numbers of `all` for messages of their own; read with `all`, those are unknown.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import pkgutil
import re
import struct
import traceback
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

from protocol.errors import UsageError
from protocol.wire.codec import Layout

BINARY = frozenset(
    {("PARAM_EXT_VALUE", "param_value"), ("PARAM_EXT_SET", "param_value"), ("PARAM_EXT_ACK", "param_value")}
)
"""Fields that are characters by their definition and hold bytes: here, a value of the kind that param_type says."""

WIDEST = "all"
_LETTERS = {
    "char": "s", "float": "f", "double": "d", "int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H",
    "int32_t": "i", "uint32_t": "I", "int64_t": "q", "uint64_t": "Q",
}  # fmt: skip
_MOST_FILES = 100

Of = TypeVar("Of", bound=Callable[..., Any])
_caches: list[Any] = []
_chosen: list[Mapping[int, Any]] = []


def of_dialect(function: Of) -> Of:
    """`functools.cache`, forgotten where another dialect is chosen."""
    cached = functools.cache(function)
    _caches.append(cached)
    return cached  # type: ignore[return-value]


def choose(name: str | None) -> None:
    """Read logs with another dialect from now on: a name among pymavlink's, or a file of definitions (.xml).

    None is the widest again. Raises UsageError where there is no such dialect, or its file cannot be read.
    """
    messages = None if name is None else _from_xml(Path(name)) if name.lower().endswith(".xml") else _named(name)
    _chosen[:] = [messages] if messages is not None else []
    for cache in _caches:
        cache.cache_clear()


def _messages() -> Mapping[int, Any]:
    """pymavlink's descriptions of the messages, by id."""
    return _chosen[0] if _chosen else _named(WIDEST)


def _named(name: str) -> Mapping[int, Any]:
    from pymavlink.dialects import v20

    names = sorted(module.name for module in pkgutil.iter_modules(v20.__path__))
    if name not in names:
        raise UsageError(
            f"--dialect {name}: there is none of that name; choose a file (.xml), or of {', '.join(names)}"
        )
    found: Mapping[int, Any] = importlib.import_module(f"pymavlink.dialects.v20.{name}").mavlink_map
    return found


def _from_xml(path: Path) -> Mapping[int, Any]:
    """The messages of a file of definitions and of those that it includes."""
    from pymavlink.generator import mavparse

    made: dict[int, Any] = {}
    waiting, seen = [path], set[Path]()
    while waiting:
        file = waiting.pop()
        if file.resolve() in seen:
            continue
        seen.add(file.resolve())
        try:
            if len(seen) > _MOST_FILES:
                raise ValueError(f"it includes more than {_MOST_FILES} files")
            with contextlib.redirect_stdout(io.StringIO()):
                parsed = mavparse.MAVXML(str(file), mavparse.PROTOCOL_2_0)
            for message in parsed.message:
                made.setdefault(message.id, _described(message))
        except Exception as error:  # noqa: BLE001  (the parser raises what a file that is none leads to)
            with warnings.catch_warnings(action="ignore", category=ResourceWarning):
                traceback.clear_frames(error.__traceback__)  # the parser leaves the file open
            what = getattr(error, "strerror", None) or re.sub(r"\s+", " ", str(error)) or type(error).__name__
            raise UsageError(f"--dialect {path}: cannot read the definitions in {file}: {what}") from None
        waiting += [file.parent / include for include in parsed.include]
    if not made:
        raise UsageError(f"--dialect {path}: there is no message in it")
    return made


def _described(message: Any) -> Any:
    """A message of a definition file as pymavlink's generated modules describe theirs."""
    fields = message.ordered_fields
    letters = "".join(f"{field.array_length or ''}{_LETTERS[field.type]}" for field in fields)
    return SimpleNamespace(
        id=message.id,
        msgname=message.name,
        fieldnames=message.fieldnames,
        fieldtypes=message.fieldtypes,
        ordered_fieldnames=[field.name for field in fields],
        array_lengths=[field.array_length for field in fields],
        crc_extra=message.crc_extra,
        unpacker=struct.Struct("<" + letters),
        fieldunits_by_name={field.name: field.units.strip("[]") for field in fields if field.units},
    )


@of_dialect
def layouts() -> Mapping[int, Layout]:
    """Every message by its id."""
    return {number: Layout(message) for number, message in _messages().items()}


@of_dialect
def layouts_by_name() -> Mapping[str, Layout]:
    """Every message by its name."""
    return {message.name: message for message in layouts().values()}


def unit(message: str, field: str) -> str:
    """The unit of a field as in the dialect ("m/s"); empty without a unit, or for a message not in the dialect."""
    known = layouts_by_name().get(message)
    units = _messages()[known.message_id].fieldunits_by_name if known else {}
    return str(units.get(field, ""))
