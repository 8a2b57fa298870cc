"""The scenario's numbers as MAVLink parameters: gains, settable while disarmed; scales, limits and gears, read only.

A name is PREFIX_SYMBOL_AXIS, 16 characters at most; a law's file names its own gains (`controller.laws.gains`). `python -m
controller.parameters` prints the table of docs/station.md with the gains of every law. Values are sent as float32; setting
a value that equals the present one in float32 changes nothing, so that a gain keeps its full precision.
"""

from __future__ import annotations

import functools
import sys
import typing
from collections.abc import Callable, Collection, Iterator
from typing import Any, NamedTuple

import msgspec
import numpy as np

from controller.laws.gains import LinkParameter
from controller.laws.registry import LAWS, declared_gains, gains_tables, law_entry, load
from protocol.errors import FwavHilError
from protocol.scenario import Scenario, Table, replace_gains, with_overrides
from protocol.wire.codec import Layout
from protocol.wire.parameter_mapping import VALUE, Kind, Refusal, encode_value

AXIS_NAMES = ("X", "Y", "Z", "ROLL", "PITCH", "YAW")


class Parameter(NamedTuple):
    """One parameter: its name, its place in the scenario (axis None: the field is one number, not six), its type.

    table: "" is the scenario itself; `gains.NAME` a table of gains of a law.
    """

    name: str
    kind: Kind
    table: str
    field: str
    axis: int | None
    settable: bool


class Group(NamedTuple):
    """The parameters of one field of the scenario."""

    prefix: str
    table: str
    field: str
    meaning: str
    kind: Kind = Kind.REAL32
    per_axis: bool = True
    settable: bool = False


_GROUPS = (
    Group("LAW_B", "control", "b", "assumed input gain over mass or inertia b (15)", settable=True),
    Group("LAW_UHAT0", "control", "uhat0", "estimate at the start, m/s^2, rad/s^2", settable=True),
    Group("LAW_ROTATE", "control", "rotate_force", "1: the force is rotated into the body", Kind.INT32, False, True),
    Group("LAW_INDEX", "", "law", "number of the law", Kind.INT32, False),
    Group("LAW_RATE_HZ", "", "rate_hz", "rate of the law, Hz", Kind.REAL32, False),
    Group("ACT_SCALE", "actuators", "scale", "force or torque of a control of 1, N, N m"),
    Group("ACT_LOWER", "actuators", "lower", "least command, N, N m"),
    Group("ACT_UPPER", "actuators", "upper", "largest command, N, N m"),
    Group("HYS_H", "hysteresis", "h", "slope of the gears (2), (3)"),
    Group("HYS_KAPPA", "hysteresis", "kappa", "slope just after the start (3)"),
    Group("HYS_CHI", "hysteresis", "chi", "chi (3), per N, per N m"),
    Group("HYS_B", "hysteresis", "B", "half width of the play (2), N, N m"),
)

_FIRST = tuple(f"LAW_{name}" for name in ("K", "LAMBDA", "B", "T", "N", "KP", "KD", "UHAT0", "ROTATE", "ORDER"))
"""Order of the indices: these first, as in existing logs, then the other groups above, then the gains of later laws."""


@functools.cache
def _gains_groups(table: str, declared: type[Table]) -> tuple[Group, ...]:
    """The groups of a law's table of gains, as its struct declares them."""
    groups = []
    for field, hint in typing.get_type_hints(declared, include_extras=True).items():
        for said in getattr(hint, "__metadata__", ()):
            if isinstance(said, LinkParameter):
                kind = Kind.INT32 if hint.__origin__ in (int, bool) else Kind.REAL32
                per_axis = typing.get_origin(hint.__origin__) is tuple
                groups.append(Group(said.prefix, f"gains.{table}", field, said.meaning, kind, per_axis, said.settable))
    return tuple(groups)


def _groups(gains: dict[str, type[Table]]) -> list[Group]:
    """All groups with these tables of gains, in the order of their indices."""
    groups = [*_GROUPS, *(group for table in gains.items() for group in _gains_groups(*table))]
    return sorted(groups, key=lambda group: _FIRST.index(group.prefix) if group.prefix in _FIRST else len(_FIRST))


def _table(scenario: Scenario, name: str) -> Any:
    if name.startswith("gains."):
        table = name.removeprefix("gains.")
        return scenario.read_gains(table, declared_gains(scenario)[table])
    return getattr(scenario, name) if name else scenario


def parameters_of(scenario: Scenario) -> tuple[Parameter, ...]:
    """The scenario's parameters, in the order of their indices.

    Gear parameters are those of the scenario's gear model; gains are those of its law and of every other gains table it has.
    """
    found = []
    for group in _groups(declared_gains(scenario)):
        if not hasattr(_table(scenario, group.table), group.field):
            continue
        for axis in range(len(AXIS_NAMES)) if group.per_axis else (None,):
            name = group.prefix if axis is None else f"{group.prefix}_{AXIS_NAMES[axis]}"
            found.append(Parameter(name, group.kind, group.table, group.field, axis, group.settable))
    return tuple(found)


def value_of(scenario: Scenario, parameter: Parameter) -> float:
    """A parameter's value, exactly as the scenario has it."""
    value = getattr(_table(scenario, parameter.table), parameter.field)
    if parameter.field == "law":
        return float(law_entry(value).number)
    return float(value if parameter.axis is None else value[parameter.axis])


def _like(old: object, value: float) -> float:
    """A received value converted to the type that the scenario holds; what does not fit is left for the scenario to reject."""
    if isinstance(old, bool):
        return bool(value) if value in (0.0, 1.0) else value
    return int(value) if isinstance(old, int) and float(value).is_integer() else value


def changed(scenario: Scenario, parameter: Parameter, value: float) -> Scenario:
    """The scenario with a settable parameter set to a value. Raises ScenarioError where that is out of range."""
    table = msgspec.to_builtins(_table(scenario, parameter.table))
    old = table[parameter.field]
    new: Any = _like(old, value)
    if parameter.axis is not None:
        new = [value if axis == parameter.axis else held for axis, held in enumerate(old)]
    if not parameter.table.startswith("gains."):
        return with_overrides(scenario, **{parameter.table: {**table, parameter.field: new}})
    other = replace_gains(scenario, parameter.table.removeprefix("gains."), **{parameter.field: new})
    _table(other, parameter.table)  # read as the law reads it
    return other


def followed(scenario: Scenario, said: Collection[tuple[str, float | None]]) -> Scenario:
    """The scenario with the gains of a log's PARAM_VALUE messages, (name, value): only values that differ in float32 change.

    Raises ScenarioError where a value is out of range.
    """
    by_name = {parameter.name: parameter for parameter in parameters_of(scenario)} if said else {}
    for name, value in said:
        parameter = by_name.get(name)
        if parameter is None or not parameter.settable or value is None:
            continue
        if np.float32(value) != np.float32(value_of(scenario, parameter)):
            scenario = changed(scenario, parameter, value)
    return scenario


class Parameters:
    """The current parameters of one controller.

    apply: takes the scenario with a changed gain, or raises an error of the project and changes nothing.

    counters   parameters_set       values that were changed        parameters_refused   set and read requests rejected
    """

    def __init__(self, scenario: Scenario, apply: Callable[[Scenario], None]) -> None:
        self.scenario = scenario
        self.table = parameters_of(scenario)
        self._index = {parameter.name: index for index, parameter in enumerate(self.table)}
        self._apply = apply
        self.counters = {"parameters_set": 0, "parameters_refused": 0}

    def index(self, name: str) -> int | None:
        """The index of a name, or None."""
        return self._index.get(name)

    def value(self, index: int) -> float:
        """The current value of a parameter."""
        return value_of(self.scenario, self.table[index])

    def saying(self, index: int) -> tuple[Layout, bytes]:
        """PARAM_VALUE with the current value of a parameter."""
        parameter = self.table[index]
        payload = encode_value(parameter.name, parameter.kind, self.value(index), index, len(self.table))
        return VALUE, payload

    def set(self, index: int, kind: int, value: float, *, armed: bool) -> Refusal | None:
        """Set a parameter; None on success, else the reason for rejecting it. The caller counts rejections."""
        parameter = self.table[index]
        if kind != parameter.kind:
            return Refusal.OUT_OF_RANGE
        if np.float32(value) == np.float32(self.value(index)):
            return None
        if not parameter.settable:
            return Refusal.READ_ONLY
        if armed:
            return Refusal.ARMED
        try:
            scenario = changed(self.scenario, parameter, value)
            self._apply(scenario)
        except FwavHilError:
            return Refusal.OUT_OF_RANGE
        self.scenario = scenario
        self.counters["parameters_set"] += 1
        return None


def markdown_table(gains: dict[str, type[Table]]) -> Iterator[str]:
    """The lines of the table in docs/station.md, with these tables of gains."""
    yield "| parameter | type | set | meaning |"
    yield "| --- | --- | --- | --- |"
    for group in _groups(gains):
        name = f"{group.prefix}_X ... _YAW" if group.per_axis else group.prefix
        place = f"`{group.table}.{group.field}`" if group.table else f"`{group.field}`"
        yield f"| {name} | {group.kind.name} | {'disarmed' if group.settable else '-'} | {place}: {group.meaning} |"


if __name__ == "__main__":
    sys.stdout.writelines(
        line + "\n" for line in markdown_table({table: load(at) for table, at in gains_tables().items()})
    )
    sys.stdout.writelines(f"LAW_INDEX {entry.number}: {name}\n" for name, entry in LAWS.items())
