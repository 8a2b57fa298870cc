"""The scenario's numbers as MAVLink parameters: gains, which may be set while disarmed; scales, limits and gears, to be read.

A name is PREFIX_SYMBOL_AXIS, 16 characters at most; `markdown_table` prints the table of docs/station.md. Values travel as
float32; a set that asks for what is there already (to float32) changes nothing, so that a gain keeps its every digit.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np

from controller.laws.registry import LAWS, law_entry
from protocol.errors import FwavHilError
from protocol.scenario import Scenario, with_overrides
from protocol.wire.codec import Layout
from protocol.wire.parameter_mapping import VALUE, Kind, Refusal, encode_value

AXIS_NAMES = ("X", "Y", "Z", "ROLL", "PITCH", "YAW")


class Parameter(NamedTuple):
    """One parameter: its name, its place in the scenario (axis None: no field of six), what it is."""

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


GROUPS = (
    Group("LAW_K", "control", "K", "gain K (13)", settable=True),
    Group("LAW_LAMBDA", "control", "Lambda", "gain Lambda (11)", settable=True),
    Group("LAW_B", "control", "b", "assumed input gain over mass or inertia b (15)", settable=True),
    Group("LAW_T", "control", "T", "time of the filter G_f, s", settable=True),
    Group("LAW_N", "control", "N", "pole of the derivative, rad/s", settable=True),
    Group("LAW_KP", "control", "Kp", "gain of PD and DOB", settable=True),
    Group("LAW_KD", "control", "Kd", "gain of PD and DOB", settable=True),
    Group("LAW_UHAT0", "control", "uhat0", "estimate at the start, m/s^2, rad/s^2", settable=True),
    Group("LAW_ROTATE", "control", "rotate_force", "1: the force is rotated into the body", Kind.INT32, False, True),
    Group("LAW_ORDER", "control", "order", "order of the filter G_f", Kind.INT32, False),
    Group(
        "LAW_INDEX",
        "",
        "law",
        f"the law: {', '.join(f'{entry.number} {name}' for name, entry in LAWS.items())}",
        Kind.INT32,
        False,
    ),
    Group("LAW_RATE_HZ", "", "rate_hz", "rate of the law, Hz", Kind.REAL32, False),
    Group("ACT_SCALE", "actuators", "scale", "what a control of 1 stands for, N, N m"),
    Group("ACT_LOWER", "actuators", "lower", "least command, N, N m"),
    Group("ACT_UPPER", "actuators", "upper", "largest command, N, N m"),
    Group("HYS_H", "hysteresis", "h", "slope of the gears (2), (3)"),
    Group("HYS_KAPPA", "hysteresis", "kappa", "slope just after the start (3)"),
    Group("HYS_CHI", "hysteresis", "chi", "chi (3), per N, per N m"),
    Group("HYS_B", "hysteresis", "B", "half width of the play (2), N, N m"),
)


def parameters_of(scenario: Scenario) -> tuple[Parameter, ...]:
    """The scenario's parameters, in the order of their indices; of the gears those that its model has."""
    found = []
    for group in GROUPS:
        if not hasattr(getattr(scenario, group.table) if group.table else scenario, group.field):
            continue
        for axis in range(len(AXIS_NAMES)) if group.per_axis else (None,):
            name = group.prefix if axis is None else f"{group.prefix}_{AXIS_NAMES[axis]}"
            found.append(Parameter(name, group.kind, group.table, group.field, axis, group.settable))
    return tuple(found)


def value_of(scenario: Scenario, parameter: Parameter) -> float:
    """A parameter's value, exactly as the scenario has it."""
    value = getattr(getattr(scenario, parameter.table) if parameter.table else scenario, parameter.field)
    if parameter.field == "law":
        return float(law_entry(value).number)
    return float(value if parameter.axis is None else value[parameter.axis])


def changed(scenario: Scenario, parameter: Parameter, value: float) -> Scenario:
    """The scenario with a settable parameter set to a value. Raises ScenarioError where that is out of range."""
    table = msgspec.to_builtins(getattr(scenario, parameter.table))
    if parameter.axis is None:
        table[parameter.field] = bool(value)
    else:
        table[parameter.field] = [
            value if axis == parameter.axis else old for axis, old in enumerate(table[parameter.field])
        ]
    return with_overrides(scenario, **{parameter.table: table})


def followed(scenario: Scenario, said: Iterable[tuple[str, float | None]]) -> Scenario:
    """The scenario with the gains that (name, value) of a log's PARAM_VALUE say: only what differs, to float32, is changed.

    Raises ScenarioError where a value is none that could have been set.
    """
    by_name = {parameter.name: parameter for parameter in parameters_of(scenario)}
    for name, value in said:
        parameter = by_name.get(name)
        if parameter is None or not parameter.settable or value is None:
            continue
        if np.float32(value) != np.float32(value_of(scenario, parameter)):
            scenario = changed(scenario, parameter, value)
    return scenario


class Parameters:
    """The parameters of one controller, as they are now.

    apply: takes the scenario with a changed gain, or raises an error of the project and changes nothing.

    counters   parameters_set       values that were changed        parameters_refused   sets and reads that were not obeyed
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
        """The value of a parameter now."""
        return value_of(self.scenario, self.table[index])

    def saying(self, index: int) -> tuple[Layout, bytes]:
        """PARAM_VALUE of a parameter now."""
        parameter = self.table[index]
        payload = encode_value(parameter.name, parameter.kind, self.value(index), index, len(self.table))
        return VALUE, payload

    def set(self, index: int, kind: int, value: float, *, armed: bool) -> Refusal | None:
        """Set a parameter; None where it now has the value, else why it has not. The caller counts refusals."""
        parameter = self.table[index]
        if kind != parameter.kind:
            return Refusal.OUT_OF_RANGE
        if np.float32(value) == np.float32(self.value(index)):
            return None
        if not parameter.settable:
            return Refusal.READ_ONLY
        if armed:
            return Refusal.ARMED
        if parameter.axis is None and value not in (0.0, 1.0):
            return Refusal.OUT_OF_RANGE
        try:
            scenario = changed(self.scenario, parameter, value)
            self._apply(scenario)
        except FwavHilError:
            return Refusal.OUT_OF_RANGE
        self.scenario = scenario
        self.counters["parameters_set"] += 1
        return None


def markdown_table() -> Iterator[str]:
    """The lines of the table as it stands in docs/station.md."""
    yield "| parameter | type | set | meaning |"
    yield "| --- | --- | --- | --- |"
    for group in GROUPS:
        name = f"{group.prefix}_X ... _YAW" if group.per_axis else group.prefix
        place = f"`{group.table}.{group.field}`" if group.table else f"`{group.field}`"
        yield f"| {name} | {group.kind.name} | {'disarmed' if group.settable else '-'} | {place}: {group.meaning} |"


if __name__ == "__main__":
    sys.stdout.writelines(line + "\n" for line in markdown_table())
