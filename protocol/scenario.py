"""Scenarios: all parameters of a run, read from a TOML file into frozen, typed, validated structs.

SI units and radians throughout; names with an equation number are the paper's symbols. An unknown key, a wrong type or a
value out of range raises `ScenarioError`, whose message names the file, the key and the remedy.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import msgspec
import tomli_w
from msgspec import Meta

from protocol import due
from protocol.errors import ScenarioError
from protocol.messages import AXES, FloatArray

Positive: TypeAlias = Annotated[float, Meta(gt=0.0)]
NotNegative: TypeAlias = Annotated[float, Meta(ge=0.0)]
Vector3: TypeAlias = tuple[float, float, float]
Vector6: TypeAlias = tuple[float, float, float, float, float, float]
Positive3: TypeAlias = tuple[Positive, Positive, Positive]
Positive6: TypeAlias = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
NotNegative6: TypeAlias = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]

ZERO6: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NANOSECONDS = due.NANOSECONDS
LONGEST_S = 4_000_000.0
"""The longest time in a scenario: 46 days, since MAVLink counts milliseconds in 32 bits."""


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of a scenario file: frozen; unknown keys are refused."""

    def __post_init__(self) -> None:
        for field, value in _floats(self):
            if not math.isfinite(value):
                raise ValueError(f"the value of {field} must be finite")


def _floats(table: msgspec.Struct) -> Iterator[tuple[str, float]]:
    for field in table.__struct_fields__:
        value = getattr(table, field)
        for item in value if isinstance(value, tuple) else (value,):
            if isinstance(item, float):
                yield field, item


class Body(Table, frozen=True):
    """The rigid body of (1). Mass in kg; Ixx, Iyy, Izz in kg m^2; gravity in m/s^2."""

    mass: Positive
    inertia: Positive3
    gravity: NotNegative


class Initial(Table, frozen=True):
    """State of the plant at t = 0, and the body command that acts until the first one arrives."""

    position: Vector3
    attitude: Vector3
    velocity: Vector3 = (0.0, 0.0, 0.0)
    attitude_rate: Vector3 = (0.0, 0.0, 0.0)
    command: Vector6 = ZERO6


class Backlash(Table, frozen=True, tag_field="model", tag="backlash"):
    """Backlash-like hysteresis (3): slope h, slope kappa just after the start, chi per N and per N m."""

    h: Positive6
    kappa: NotNegative6
    chi: Positive6

    def __post_init__(self) -> None:
        super().__post_init__()
        for axis, h, kappa in zip(AXES, self.h, self.kappa, strict=True):
            if kappa >= h:
                raise ValueError(f"kappa must be below h, but is not on axis {axis} ({kappa} >= {h})")


class Play(Table, frozen=True, tag_field="model", tag="play"):
    """The play operator (2): slope h, half width B in units of the command (N, N m)."""

    h: Positive6
    B: NotNegative6


class Disturbance(Table, frozen=True):
    """A body force and torque at the gear output, amplitude * sin(frequency * t); N, N m, rad/s."""

    amplitude: Vector6
    frequency_rad_s: NotNegative


class Actuators(Table, frozen=True):
    """Limits in the body frame (N, N m), the wire scale of each channel, and the safe command that replaces a stale one."""

    lower: Vector6
    upper: Vector6
    scale: Positive6
    safe: Vector6 = ZERO6
    staleness_s: Positive = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        for axis, low, high, scale, safe in zip(AXES, self.lower, self.upper, self.scale, self.safe, strict=True):
            if not low <= 0.0 <= high or low == high:
                raise ValueError(f"lower and upper must enclose zero, but do not on axis {axis} ({low}, {high})")
            if scale < max(-low, high):
                raise ValueError(f"scale must be at least the larger limit, but is not on axis {axis} ({scale})")
            if not low <= safe <= high:
                raise ValueError(f"safe must lie within the limits, but does not on axis {axis} ({safe})")


class Delay(Table, frozen=True):
    """Delay from a sample to the action of its command: whole periods plus seconds."""

    samples: Annotated[int, Meta(ge=0, le=1000)] = 0
    seconds: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0


class Noise(Table, frozen=True):
    """Standard deviation of the measured position (m) and of each measured attitude angle (rad)."""

    position: NotNegative = 0.0
    attitude: NotNegative = 0.0


class Reference(Table, frozen=True):
    """Reference model (12), (31), its start, and the command c(t) = amplitude sin(frequency t + phase) of (32), (33)."""

    A_d: Positive6
    B_d: Positive6
    C_d: Vector6
    amplitude: Vector6
    frequency_rad_s: NotNegative6
    phase_rad: Vector6 = ZERO6
    initial: Vector6 = ZERO6


class Control(Table, frozen=True):
    """The vehicle model that all laws assume.

    b             input gain over mass or inertia (15), 1/kg, 1/(kg m^2)
    uhat0         estimate of u_d at the start, m/s^2, rad/s^2
    rotate_force  whether the force is rotated from the inertial frame into the body frame
    """

    b: Positive6
    uhat0: Vector6 = ZERO6
    rotate_force: bool = True


class World(Table, frozen=True):
    """Place of the emulated vehicle: for real autopilots, never for the laws. Field in gauss, temperature in Celsius."""

    latitude_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] = 47.397742
    longitude_deg: Annotated[float, Meta(ge=-180.0, le=180.0)] = 8.545594
    altitude: float = 488.0
    magnetic_field_ned: Vector3 = (0.21523, 0.01045, 0.42774)
    temperature_celsius: float = 15.0


class Wire(Table, frozen=True):
    """Identity of the emulator on the link: its MAVLink component id."""

    emulator_component: Annotated[int, Meta(ge=2, le=255)] = 191


class Motor(Table, frozen=True):
    """The drives on a CAN bus, six of the same type; without a bus (`--motor direct`) this table is not used.

    bitrate             of the bus, bit/s; load and delay are calculated with it
    first_node_id       the drive of axis i has node id first_node_id + i
    full_scale_nm       torque on the bus that represents `actuators.scale` of an axis. A power of two makes this exact.
    lag_s               time constant of the drive's torque (current) loop        loop_hz  rate of that loop
    rate_limit          fastest change of an axis, in full scales per second; 0: none
    torque_limit        largest torque of an axis, as a fraction of full scale
    watchdog_s          without a command for this long the drive changes to `actuators.safe` and latches an error
    temperature_rise    steady rise at full torque (K), with time constant thermal_time_constant_s; proportional to torque^2
    over_temperature_celsius    above it the drive changes to `actuators.safe` and latches an error
    torque_constant     N m per A of motor current        bus_voltage  of the supply, V
    travel_rad          shaft angle that represents `actuators.scale`: motor side for tau, output side for u
    encoder_counts      per turn, both sides              velocity_resolution  rad/s; 0: exact
    *_rate_hz           cyclic messages: encoder, heartbeat, and the rest of the status
    bus_delay           commands act later by their worst waiting and transmission time on the bus
    mit_*               ranges of the MIT frames (each +-) and length of a reply, which depend on the motor
    """

    protocol: str = "odrive"
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 1_000_000
    first_node_id: Annotated[int, Meta(ge=1, le=38)] = 21
    full_scale_nm: Positive = 16.0
    lag_s: NotNegative = 0.001
    loop_hz: Positive = 8000.0
    rate_limit: NotNegative6 = ZERO6
    torque_limit: Positive6 = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    watchdog_s: Positive = 0.05
    temperature_rise: NotNegative = 60.0
    thermal_time_constant_s: Positive = 60.0
    over_temperature_celsius: float = 100.0
    torque_constant: Positive = 0.82
    bus_voltage: Positive = 24.0
    travel_rad: Positive = 1.0
    encoder_counts: Annotated[int, Meta(ge=4, le=1 << 24)] = 16384
    velocity_resolution: NotNegative = 0.0
    encoder_rate_hz: Positive = 100.0
    heartbeat_rate_hz: Positive = 10.0
    status_rate_hz: Positive = 20.0
    bus_delay: bool = False
    mit_position_range: Positive = 12.5
    mit_velocity_range: Positive = 50.0
    mit_torque_range: Positive = 18.0
    mit_reply_bytes: Literal[5, 6, 8] = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lag_s > 0.0 and self.lag_s * self.loop_hz < 1.0:
            raise ValueError(f"lag_s must be 0, or at least one period of the torque loop ({1 / self.loop_hz:g} s)")


AnyTable = TypeVar("AnyTable", bound=Table)


class Scenario(Table, frozen=True):
    """A complete run. Times in s, rates in Hz; the period is a whole number of nanoseconds (`period_ns`).

    gains: tables by name, as in the file. Each law declares its own table as a struct, with which `read_gains` validates it
    when the law is used and not before, because an emulator does not use laws.
    """

    name: Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9_\-]*$")]
    description: str
    rate_hz: Positive
    duration_s: Positive
    seed: Annotated[int, Meta(ge=0)]
    law: str
    substep_s: Positive
    body: Body
    initial: Initial
    hysteresis: Backlash | Play
    actuators: Actuators
    reference: Reference
    control: Control
    gains: Mapping[str, Any] = {}
    delay: Delay = Delay()
    noise: Noise = Noise()
    disturbance: Disturbance = Disturbance(amplitude=ZERO6, frequency_rad_s=0.0)
    world: World = World()
    wire: Wire = Wire()
    motor: Motor = Motor()

    def __post_init__(self) -> None:
        super().__post_init__()
        if max(1.0 / self.rate_hz, self.duration_s, self.substep_s) > LONGEST_S:
            raise ValueError(
                f"the period 1 / rate_hz, duration_s and substep_s must be at most {LONGEST_S:.0f} s each: "
                "choose a higher rate or a shorter time"
            )
        if self.period_ns % 1000 or abs(self.period_ns * self.rate_hz / NANOSECONDS - 1.0) > 1e-9:
            raise ValueError(
                f"rate_hz {self.rate_hz:g} has a period of {1e6 / self.rate_hz:.3f} us, which is not a whole number of "
                "microseconds (time stamps on the link count those): choose a rate such as 100, 200, 250, 400, 500 or 1000"
            )
        if self.period_ns % self.substep_ns or abs(self.substep_ns / (self.substep_s * NANOSECONDS) - 1.0) > 1e-6:
            raise ValueError(
                f"substep_s {self.substep_s:g} does not divide the period of "
                f"{self.period_ns / NANOSECONDS:g} s into whole steps: choose substep_s = period / n"
            )
        if self.ticks < 1:
            raise ValueError(f"duration_s {self.duration_s:g} is shorter than one period: make it longer")
        if abs(self.initial.attitude[1]) > 1.4:
            raise ValueError(
                "initial.attitude has a pitch beyond 1.4 rad, the limit of the equations: choose a smaller one"
            )
        for axis, low, high, command in zip(
            AXES, self.actuators.lower, self.actuators.upper, self.initial.command, strict=True
        ):
            if not low <= command <= high:
                raise ValueError(f"initial.command must lie within the actuator limits, but does not on axis {axis}")

    @property
    def period_ns(self) -> int:
        """Control period, ns."""
        return round(NANOSECONDS / self.rate_hz)

    @property
    def substep_ns(self) -> int:
        """Integration step, ns."""
        return max(1, round(self.substep_s * NANOSECONDS))

    @property
    def ticks(self) -> int:
        """Number of control periods in the run; t_k = k periods, k = 0 .. ticks - 1."""
        return round(self.duration_s * NANOSECONDS / self.period_ns)

    @property
    def delay_ns(self) -> int:
        """From a sample to the action of its command, ns."""
        return self.delay.samples * self.period_ns + round(self.delay.seconds * NANOSECONDS)

    @property
    def initial_motion(self) -> FloatArray:
        """(12,) position, attitude, velocity, attitude rate at t = 0."""
        start = self.initial
        import numpy as np  # imported here: see `protocol.messages`

        return np.array((*start.position, *start.attitude, *start.velocity, *start.attitude_rate))

    def read_gains(self, table: str, declared: type[AnyTable], source: object = None) -> AnyTable:
        """The table [gains.TABLE] as the struct that a law declares for it; `source` names the file in error messages.

        Raises ScenarioError.
        """
        return _convert(self.gains.get(table, {}), declared, str(source or f"scenario {self.name}"), f"gains.{table}")

    def digest(self) -> bytes:
        """8 bytes that must agree between emulator and controller: of all keys except those that one end may override.

        All tables of gains in the file count, whichever law flies, since the emulator's run folder stores the file as the
        scenario flown. A gain that is not in the file (default) does not count, nor does [motor], which the controller does
        not use.
        """
        return self._digest(without_motor=True)

    def drive_digest(self) -> bytes:
        """8 bytes that must agree between emulator and drives: of the keys of `digest`, and of [motor]."""
        return self._digest(without_motor=False)

    def _digest(self, *, without_motor: bool) -> bytes:
        common = msgspec.structs.replace(self, rate_hz=1000.0, substep_s=0.001, duration_s=1.0, seed=0, law="")
        document = msgspec.to_builtins(common)
        document["gains"] = _with_float_numbers(document["gains"])  # 2 counts as 2.0
        if without_motor:
            del document["motor"]
        return hashlib.sha256(msgspec.json.encode(document, order="sorted")).digest()[:8]

    def to_toml(self) -> str:
        """The complete scenario as TOML, including defaults."""
        return tomli_w.dumps(msgspec.to_builtins(self))


def with_overrides(scenario: Scenario, **changes: Any) -> Scenario:
    """A copy with top-level keys replaced; None leaves a key unchanged. Raises `ScenarioError`."""
    chosen = {key: value for key, value in changes.items() if value is not None}
    document = msgspec.to_builtins(scenario) | chosen
    return _convert(document, Scenario, "the command line")


def replace_gains(scenario: Scenario, table: str, **gains: Any) -> Scenario:
    """A copy with these gains of [gains.TABLE]; they are validated when a law reads them."""
    as_in_a_file = {name: list(gain) if isinstance(gain, tuple) else gain for name, gain in gains.items()}
    changed = {**scenario.gains.get(table, {}), **as_in_a_file}
    return msgspec.structs.replace(scenario, gains={**scenario.gains, table: changed})


def scenario_folder() -> Path:
    """Folder of the project's own scenarios: beside the packages in a checkout, within a package when installed."""
    root = Path(__file__).resolve().parent.parent
    beside = root / "scenarios"
    return beside if (beside / "flapper.toml").exists() else root / "fwav_hil" / "scenarios"


def find_scenario(name: str) -> Path:
    """The scenario file for a path, or for the name of one of the project's own scenarios. Raises ScenarioError."""
    path = Path(name)
    with contextlib.suppress(OSError):  # a name too long for the system, or a folder without search permission
        if path.exists():
            return path
    known = {file.stem: file for file in sorted(scenario_folder().glob("*.toml"))}
    if path.stem in known and path.parent.name in ("", "scenarios"):
        return known[path.stem]
    raise ScenarioError(f"there is no scenario {name}: give a file, or one of {', '.join(known)}")


def load_scenario(path: Path) -> Scenario:
    """Read and validate a scenario file. Raises `ScenarioError`.

    A file may begin with `extends = "other.toml"`, a file in the same folder: it then contains only the differences to it.
    """
    return _convert(_read_document(path, ()), Scenario, str(path))


def parse_scenario(text: str, source: str) -> Scenario:
    """Read and validate the text of a whole scenario; `source` names it in error messages. Raises `ScenarioError`."""
    return _convert(_parse_document(text, source), Scenario, source)


def _read_document(path: Path, extending: tuple[Path, ...]) -> dict[str, Any]:
    """The tables of a file merged into those of the file that it extends; `extending` lists the files read so far."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ScenarioError(f"cannot read the scenario {path}: {reason}") from None
    document = _parse_document(text, str(path))
    base = document.pop("extends", None)
    if base is None:
        return document
    if not isinstance(base, str) or path.resolve() in extending:
        raise ScenarioError(f"{path}, extends: name one other scenario file, without a circle of extends")
    return _merge(_read_document(path.parent / base, (*extending, path.resolve())), document)


_ONCE_IN_CONTROL = {"ude": ("K", "Lambda"), "filters": ("T", "N", "order"), "pd": ("Kp", "Kd")}
"""Gains that were in [control] in earlier versions: scenarios in old run folders can still be read."""


def _parse_document(text: str, source: str) -> dict[str, Any]:
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, a number of too many digits, nesting too deep
        raise ScenarioError(f"{source} is not valid TOML: {error}") from None
    control, gains = document.get("control"), document.setdefault("gains", {})
    if isinstance(control, dict) and isinstance(gains, dict):
        for name, keys in _ONCE_IN_CONTROL.items():
            if name not in gains and (moved := {key: control.pop(key) for key in keys if key in control}):
                gains[name] = moved
    return document


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`base` updated with `changes`; tables are merged key by key, but a table of another model is replaced as a whole."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict) and value.get("model") in (None, old.get("model")):
            value = _merge(old, value)  # noqa: PLW2901
        merged[key] = value
    return merged


def _convert(document: Any, kind: type[AnyTable], source: str, within: str = "") -> AnyTable:
    """A document, or one of its tables (`within`: the dotted key), as its struct. Raises ScenarioError."""
    try:
        return msgspec.convert(document, kind)
    except msgspec.ValidationError as error:
        raise ScenarioError(_sentence(str(error), source, within, kind, document)) from None


def _sentence(message: str, source: str, within: str, kind: type[Table], document: Any) -> str:
    """Convert the library's message into one that names the file, the key and the remedy."""
    reason, _, path = message.partition(" - at `")
    key = path.removesuffix("`").removeprefix("$").removeprefix(".")
    place = ".".join(part for part in (within, key) if part)
    if unknown := re.search(r"unknown field `(.+)`", reason):
        return unknown_key(source, place, unknown[1], _known_keys(kind, key, document))
    if missing := re.search(r"missing required field `(.+)`", reason):
        return f"{source}: the key '{f'{place}.' if place else ''}{missing[1]}' is missing: add it"
    reason = reason[0].lower() + reason[1:].replace("`", "")
    return f"{source}{f', {place}' if place else ''}: {reason}" + ("" if ":" in reason else ": change this value")


def unknown_key(source: object, place: str, key: str, known: list[str]) -> str:
    """Error message for an unknown key in the table `place`, with the most similar key or all known ones."""
    near = difflib.get_close_matches(key, known, n=1)
    remedy = f"did you mean '{near[0]}'?" if near else f"known here: {', '.join(known)}"
    return f"{source}: unknown key '{f'{place}.' if place else ''}{key}': {remedy}"


def _known_keys(kind: type[Table], place: str, document: dict[str, Any]) -> list[str]:
    if place == "hysteresis":
        kind = Play if document[place]["model"] == "play" else Backlash
    elif place:
        kind = globals()[kind.__annotations__[place]]
    return list(kind.__struct_fields__)


def _with_float_numbers(value: Any) -> Any:
    """The same JSON value with each whole number as a float."""
    if isinstance(value, dict):
        return {name: _with_float_numbers(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_with_float_numbers(one) for one in value]
    return float(str(value)) if type(value) is int else value  # of text: one beyond all floats is infinite
