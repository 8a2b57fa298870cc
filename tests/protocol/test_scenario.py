"""Scenario files: what is read, what is refused and in which words, and the whole numbers that come of it."""

from __future__ import annotations

import copy
import math
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from controller.laws.registry import check_law, gains_tables
from protocol.errors import ScenarioError
from protocol.scenario import (
    Backlash,
    Play,
    Positive6,
    Scenario,
    Table,
    find_scenario,
    load_scenario,
    parse_scenario,
    replace_gains,
    scenario_folder,
    with_overrides,
)

FILES = sorted(scenario_folder().glob("*.toml"))
FLAPPER = load_scenario(scenario_folder() / "flapper.toml")
FULL: dict[str, Any] = tomllib.loads(FLAPPER.to_toml())
"""Every key of a scenario, the defaults too."""
TABLES = [
    "",
    *(key for key, value in FULL.items() if isinstance(value, dict)),
    *(f"gains.{key}" for key in FULL["gains"]),
]
SOURCE = "here/my.toml"

CHOSEN_BY_THE_COMMAND_LINE = {"rate_hz", "substep_s", "duration_s", "seed", "law"}
"""What one end may choose for itself, so that it does not count in the digest."""
OPTIONAL = {
    *("initial.velocity", "initial.attitude_rate", "initial.command", "actuators.safe", "actuators.staleness_s"),
    *("reference.phase_rad", "reference.initial", "control.uhat0", "control.rotate_force"),
    *("delay.samples", "delay.seconds", "noise.position", "noise.attitude"),
    *("world.latitude_deg", "world.longitude_deg", "world.altitude"),
    *("world.magnetic_field_ned", "world.temperature_celsius", "wire.emulator_component"),
    *(f"motor.{key}" for key in FULL["motor"]),
}
OF_THE_DRIVES = {f"motor.{key}" for key in FULL["motor"]}
"""What emulator and drives must share, and the controller need not know."""


def leaves(table: dict[str, Any], place: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of everything that is no table."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{place}{key}.")
        else:
            yield place + key, value


LEAVES = dict(leaves(FULL))
VECTORS = [key for key, value in LEAVES.items() if isinstance(value, list)]
FLOATS = [key for key, value in LEAVES.items() if isinstance(value, float)]
MISSING = object()
NEARLY_ONE = st.sampled_from([0.0, 1e-12, -1e-12, 1e-8, -1e-8])


def table_at(place: str, document: dict[str, Any] = FULL) -> dict[str, Any]:
    """The table at a dotted key; "": the document."""
    for step in filter(None, place.split(".")):
        document = document[step]
    return document


def changed(key: str, value: object, document: dict[str, Any] = FULL) -> dict[str, Any]:
    """The document with one dotted key set, or left out."""
    document = copy.deepcopy(document)
    place, _, name = key.rpartition(".")
    table = table_at(place, document)
    if value is MISSING:
        del table[name]
    else:
        table[name] = value
    return document


def parse(document: dict[str, Any]) -> Scenario:
    """The scenario as a command loads it that flies a law: the gains checked too."""
    scenario = parse_scenario(tomli_w.dumps(document), SOURCE)
    check_law(with_overrides(scenario, law="ude"), SOURCE)
    return scenario


def refusal(document: dict[str, Any]) -> str:
    """What a user reads: one line that begins with the file."""
    with pytest.raises(ScenarioError) as caught:
        parse(document)
    message = str(caught.value)
    assert message.startswith(SOURCE)
    assert "\n" not in message
    return message


def attempt(make: Callable[[], Scenario]) -> Scenario | str:
    """The scenario, or what a user reads instead."""
    try:
        return make()
    except ScenarioError as error:
        return str(error)


def assert_refused(key: str, value: object, remedy: str = "change this value") -> None:
    message = refusal(changed(key, value))
    for step in key.split("."):
        assert re.search(rf"\b{step}\b", message)
    assert message.rpartition(": ")[2].startswith(remedy)


def last_changed(value: Any, change: Any) -> Any:
    """A scalar, or the last element of a vector, put through `change`."""
    return [*value[:-1], change(value[-1])] if isinstance(value, list) else change(value)


class TestFiles:
    @pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
    def test_every_scenario_of_the_project_loads_under_its_own_name(self, file: Path) -> None:
        scenario = load_scenario(file)
        assert scenario.name == file.stem
        assert scenario.ticks * scenario.period_ns == round(scenario.duration_s * 1e9)

    @pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
    def test_every_number_of_a_file_arrives_where_it_belongs(self, file: Path) -> None:
        scenario = load_scenario(file)
        for key, value in leaves(tomllib.loads(file.read_text())):
            if key == "hysteresis.model":
                assert isinstance(scenario.hysteresis, {"backlash": Backlash, "play": Play}[value])
            if key in ("hysteresis.model", "extends"):
                continue
            held: Any = scenario
            for step in key.split("."):
                held = held[step] if isinstance(held, Mapping) else getattr(held, step)
            assert held == (tuple(value) if isinstance(held, tuple) else value), key

    def test_there_are_the_paper_and_the_flapper(self) -> None:
        assert {"paper", "flapper"} <= {file.stem for file in FILES}

    @pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
    def test_a_scenario_written_out_is_the_same_scenario(self, file: Path) -> None:
        scenario = load_scenario(file)
        again = parse_scenario(scenario.to_toml(), "again")
        assert again == scenario
        assert again.digest() == scenario.digest()
        assert again.to_toml() == scenario.to_toml()

    def test_the_other_hysteresis_is_written_out_and_read_too(self) -> None:
        play = parse(changed("hysteresis", {"model": "play", "h": [1.5] * 6, "B": [0.0, 1e-3, 0.0, 0.0, 0.0, 1e-6]}))
        assert isinstance(play.hysteresis, Play)
        assert play.hysteresis.B == (0.0, 1e-3, 0.0, 0.0, 0.0, 1e-6)
        assert parse_scenario(play.to_toml(), "again") == play

    @pytest.mark.parametrize("key", sorted(OPTIONAL))
    def test_a_key_with_a_default_may_be_left_out(self, key: str) -> None:
        parse(changed(key, MISSING))

    @pytest.mark.parametrize("table", ["delay", "noise", "disturbance", "world", "wire", "motor"])
    def test_a_table_with_a_default_may_be_left_out(self, table: str) -> None:
        parse(changed(table, MISSING))

    def test_by_default_nothing_disturbs_delays_or_moves(self) -> None:
        bare = FULL
        for table in ("delay", "noise", "disturbance"):
            bare = changed(table, MISSING, bare)
        scenario = parse(bare)
        assert scenario.delay_ns == 0
        assert (scenario.noise.position, scenario.noise.attitude) == (0.0, 0.0)
        assert scenario.disturbance.amplitude == (0.0,) * 6

    def test_a_whole_number_will_do_where_a_float_is_meant(self) -> None:
        assert parse(changed("body.gravity", 9)).body.gravity == 9.0

    def test_a_scenario_cannot_be_changed(self) -> None:
        table: Any = FLAPPER.body
        with pytest.raises(AttributeError):
            table.mass = 1.0

    def test_the_initial_motion_is_position_attitude_and_their_rates(self) -> None:
        document = FULL
        for number, key in enumerate(("position", "attitude", "velocity", "attitude_rate")):
            document = changed(f"initial.{key}", [number + 0.1, number + 0.2, number + 0.3], document)
        document = changed("initial.attitude", [1.1, 1.2, 1.3], document)
        expected = [0.1, 0.2, 0.3, 1.1, 1.2, 1.3, 2.1, 2.2, 2.3, 3.1, 3.2, 3.3]
        assert np.array_equal(parse(document).initial_motion, expected)


class TestFinding:
    @pytest.mark.parametrize("name", ["flapper", "flapper.toml", "scenarios/flapper", "scenarios/flapper.toml"])
    def test_a_scenario_of_the_project_goes_by_its_name(
        self, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        assert load_scenario(find_scenario(name)) == FLAPPER

    def test_a_file_that_is_there_goes_before_a_name(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "flapper.toml").write_text(tomli_w.dumps(changed("description", "mine")))
        assert load_scenario(find_scenario("flapper.toml")).description == "mine"

    @pytest.mark.parametrize("name", ["hover", "elsewhere/flapper.toml", "", "x" * 5000])
    def test_what_is_not_there_is_named_with_what_is(
        self, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ScenarioError) as caught:
            load_scenario(find_scenario(name))
        assert name in str(caught.value)
        if name:
            assert "flapper, paper" in str(caught.value)

    def test_a_file_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError, match=f"cannot read the scenario {tmp_path}/no.toml: No such file"):
            load_scenario(tmp_path / "no.toml")

    def test_a_folder_is_no_scenario(self, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError, match=f"cannot read the scenario {tmp_path}: Is a directory"):
            load_scenario(tmp_path)

    def test_a_file_that_is_no_text_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "a.toml").write_bytes(b"name = '\xff'")
        with pytest.raises(ScenarioError, match=r"a\.toml: not UTF-8 text"):
            load_scenario(tmp_path / "a.toml")


class TestUnknownAndMissingKeys:
    @pytest.mark.parametrize("table", TABLES)
    def test_an_unknown_key_is_named_with_its_place_and_those_that_are_known(self, table: str) -> None:
        key = f"{table}.xyzzy" if table else "xyzzy"
        message = refusal(changed(key, 1.0))
        known = table_at(table).keys() - {"model"}
        listed = message.partition("known here: ")[2].split(", ")
        assert f"unknown key '{key}'" in message
        assert set(listed) == (gains_tables().keys() if table == "gains" else known)
        assert set(listed) >= known

    @pytest.mark.parametrize(
        ("key", "meant"),
        [("lwa", "law"), ("dealy", "delay"), ("body.gravty", "gravity"), ("gains.ude.lambda", "Lambda")]
        + [("control.rotate_froce", "rotate_force"), ("gains.udee", "ude"), ("gains.filters.ordre", "order")]
        + [
            ("hysteresis.kapa", "kappa"),
            ("world.altitud", "altitude"),
            ("wire.emulator_componnet", "emulator_component"),
        ],
    )
    def test_a_slip_of_the_pen_is_told_what_was_meant(self, key: str, meant: str) -> None:
        message = refusal(changed(key, 1.0))
        assert f"unknown key '{key}'" in message
        assert message.endswith(f"did you mean '{meant}'?")

    def test_a_key_of_the_other_hysteresis_is_not_proposed(self) -> None:
        message = refusal(changed("hysteresis.model", "play"))
        assert "unknown key 'hysteresis.kappa'" in message or "unknown key 'hysteresis.chi'" in message
        assert message.endswith("known here: h, B")

    @pytest.mark.parametrize("key", sorted(LEAVES.keys() - OPTIONAL))
    def test_a_missing_key_is_named_with_its_place(self, key: str) -> None:
        message = refusal(changed(key, MISSING))
        assert message == f"{SOURCE}: the key '{key}' is missing: add it"

    @pytest.mark.parametrize("table", ["body", "initial", "hysteresis", "actuators", "reference", "control"])
    def test_a_missing_table_is_named(self, table: str) -> None:
        assert refusal(changed(table, MISSING)) == f"{SOURCE}: the key '{table}' is missing: add it"


class TestValues:
    @pytest.mark.parametrize("key", LEAVES)
    def test_a_wrong_type_is_refused(self, key: str) -> None:
        wrong = 1 if isinstance(LEAVES[key], (str, bool)) else "fast"
        assert_refused(key, wrong)
        assert_refused(key, {"a": 1.0})
        if not isinstance(LEAVES[key], bool):
            assert_refused(key, True)

    @pytest.mark.parametrize("table", TABLES[1:])
    @pytest.mark.parametrize("wrong", [3.0, "none", [1.0]])
    def test_a_table_that_is_none_is_refused(self, table: str, wrong: object) -> None:
        assert_refused(table, wrong)

    @pytest.mark.parametrize("key", FLOATS + VECTORS)
    def test_what_is_not_finite_is_refused(self, key: str) -> None:
        for bad in (math.nan, math.inf, -math.inf):
            assert_refused(key, last_changed(LEAVES[key], lambda _, bad=bad: bad))

    @pytest.mark.parametrize("key", VECTORS)
    def test_a_vector_of_another_length_is_refused(self, key: str) -> None:
        vector = LEAVES[key]
        for wrong in (vector[:-1], [*vector, vector[-1]], []):
            assert_refused(key, wrong)

    @pytest.mark.parametrize("key", VECTORS)
    def test_a_vector_with_an_element_of_another_type_is_refused(self, key: str) -> None:
        assert_refused(key, [*LEAVES[key][:-1], "far"])

    @pytest.mark.parametrize(
        "key",
        ["body.mass", "body.inertia", "hysteresis.h", "hysteresis.chi", "actuators.scale", "actuators.staleness_s"]
        + [
            "reference.A_d",
            "reference.B_d",
            "control.b",
            "gains.ude.K",
            "gains.ude.Lambda",
            "gains.filters.T",
            "gains.filters.N",
        ]
        + ["rate_hz", "duration_s", "substep_s"],
    )
    def test_zero_and_less_are_refused_where_there_is_no_such_thing(self, key: str) -> None:
        for wrong in (0.0, -1.0):
            assert_refused(key, last_changed(LEAVES[key], lambda _, wrong=wrong: wrong))

    @pytest.mark.parametrize(
        "key",
        ["body.gravity", "hysteresis.kappa", "noise.position", "noise.attitude", "disturbance.frequency_rad_s"]
        + ["reference.frequency_rad_s", "gains.pd.Kp", "gains.pd.Kd", "delay.samples", "delay.seconds", "seed"],
    )
    def test_less_than_zero_is_refused_and_zero_is_not(self, key: str) -> None:
        number = type(LEAVES[key][-1] if isinstance(LEAVES[key], list) else LEAVES[key])
        assert_refused(key, last_changed(LEAVES[key], lambda _: number(-1)))
        parse(changed(key, last_changed(LEAVES[key], lambda _: number(0))))

    @pytest.mark.parametrize(
        ("key", "wrong"),
        [
            ("delay.samples", 1001),
            ("delay.seconds", 1.5),
            ("gains.filters.order", 0),
            ("gains.filters.order", 7),
            ("world.latitude_deg", 90.5),
            ("world.longitude_deg", -180.5),
            ("wire.emulator_component", 1),  # the controller's
            ("wire.emulator_component", 256),
            ("seed", 1.5),
            ("name", "a b"),
            ("name", ""),
            ("name", "../up"),
            ("hysteresis.model", "deadband"),
            ("body.mass", 10**400),
        ],
    )
    def test_out_of_range_is_refused(self, key: str, wrong: object) -> None:
        assert_refused(key, wrong)

    @pytest.mark.parametrize("axis", range(6))
    def test_kappa_must_be_below_h(self, axis: int) -> None:
        for above in (1.0, 1.5):
            kappa = [0.5] * 6
            kappa[axis] = above
            message = refusal(changed("hysteresis", FULL["hysteresis"] | {"h": [1.0] * 6, "kappa": kappa}))
            assert "hysteresis" in message
            assert "kappa must be below h" in message
            assert f"axis {('x', 'y', 'z', 'alpha', 'beta', 'gamma')[axis]} " in message

    @pytest.mark.parametrize(("key", "value"), [("lower", -0.05), ("upper", 0.05)])
    def test_the_scale_must_hold_both_limits(self, key: str, value: float) -> None:
        # On x the limits of flapper.toml are -0.04, 0.04, and the scale 0.04.
        message = refusal(changed(f"actuators.{key}", [value, *LEAVES[f"actuators.{key}"][1:]]))
        assert "actuators: scale must be at least the larger limit" in message
        assert "axis x" in message

    @pytest.mark.parametrize(("lower", "upper"), [(0.01, 0.02), (-0.02, -0.01), (0.0, 0.0), (0.01, -0.01)])
    def test_the_limits_must_enclose_zero(self, lower: float, upper: float) -> None:
        table = FULL["actuators"] | {
            "lower": [*FULL["actuators"]["lower"][:1], lower, *FULL["actuators"]["lower"][2:]],
            "upper": [*FULL["actuators"]["upper"][:1], upper, *FULL["actuators"]["upper"][2:]],
        }
        message = refusal(changed("actuators", table))
        assert "actuators: lower and upper must enclose zero" in message
        assert "axis y" in message

    @pytest.mark.parametrize("key", ["actuators.safe", "initial.command"])
    @pytest.mark.parametrize("value", [-0.13, 0.03])
    def test_safe_and_initial_command_must_lie_within_the_limits(self, key: str, value: float) -> None:
        # On z the limits of flapper.toml are -0.12, 0.02.
        vector = [0.0, 0.0, value, 0.0, 0.0, 0.0]
        message = refusal(changed(key, vector))
        assert key.partition(".")[2] in message
        assert "must lie within the" in message
        assert "axis z" in message

    @pytest.mark.parametrize("pitch", [1.41, -1.41])
    def test_a_start_near_the_gimbal_lock_is_refused(self, pitch: float) -> None:
        assert_refused("initial.attitude", [0.0, pitch, 0.0], remedy="choose a smaller one")
        parse(changed("initial.attitude", [3.0, math.copysign(1.4, pitch), 3.0]))


class TestTimes:
    @pytest.mark.parametrize("rate", [3.0, 300.0, 333.3, 999.0, 3e5, 1e7, 1e300])
    def test_a_period_that_is_no_whole_number_of_microseconds_is_refused(self, rate: float) -> None:
        assert_refused("rate_hz", rate, remedy="choose a rate such as")

    @pytest.mark.parametrize("substep", [3e-4, 0.0015, 0.008, 0.0040001, 1e-12, 4.4e-9])
    def test_a_substep_that_does_not_fit_is_refused(self, substep: float) -> None:
        assert_refused("substep_s", substep, remedy="choose substep_s = period / n")

    @pytest.mark.parametrize("duration", [1e-300, 1e-9, 0.0019])
    def test_a_run_shorter_than_one_period_is_refused(self, duration: float) -> None:
        assert_refused("duration_s", duration, remedy="make it longer")

    @pytest.mark.parametrize(
        ("key", "value"),
        [("rate_hz", 1e-300), ("rate_hz", 5e-324), ("duration_s", 1e300), ("duration_s", 5e6), ("substep_s", 1e300)],
    )
    def test_times_beyond_what_the_wire_can_count_are_refused(self, key: str, value: float) -> None:
        # ATTITUDE_TARGET and its like count milliseconds in 32 bits.
        assert_refused(key, value, remedy="choose a higher rate or a shorter time")
        assert 4e6 * 1000 < 2**32

    @settings(max_examples=80)
    @given(st.integers(1, 10**6), st.integers(1, 20), st.integers(1, 10**5), st.integers(0, 1000))
    def test_all_times_are_whole_and_exact(self, period_us: int, parts: int, ticks: int, samples: int) -> None:
        assume(ticks * period_us <= 4 * 10**12)
        scenario = with_overrides(
            FLAPPER,
            rate_hz=1e6 / period_us,
            substep_s=period_us / 1e6,
            duration_s=ticks * period_us / 1e6,
            delay={"samples": samples, "seconds": 0.0},
        )
        assert scenario.period_ns == 1000 * period_us
        assert scenario.ticks == ticks
        assert scenario.delay_ns == samples * 1000 * period_us
        assume(1000 * period_us % parts == 0)
        finer = with_overrides(scenario, substep_s=period_us / 1e6 / parts)
        assert finer.substep_ns * parts == finer.period_ns
        for value in (finer.period_ns, finer.substep_ns, finer.ticks, finer.delay_ns):
            assert type(value) is int

    @settings(max_examples=80)
    @given(st.floats(1.0, 1e5) | st.builds(lambda us, off: 1e6 / us * (1 + off), st.integers(10, 10**6), NEARLY_ONE))
    def test_any_rate_is_exact_or_refused(self, rate: float) -> None:
        period_us = 10**6 / Fraction(rate)
        off = abs(round(period_us) / period_us - 1)
        assume(not 5e-10 < off < 5e-9)  # the bound between the two is 1e-9
        came = attempt(lambda: with_overrides(FLAPPER, rate_hz=rate, substep_s=max(1, round(period_us)) / 1e6))
        if off > 1e-9:
            assert isinstance(came, str)
            assert "choose a rate such as" in came
        else:
            assert isinstance(came, Scenario)
            assert came.period_ns == 1000 * round(period_us)

    def test_a_delay_adds_whole_periods_and_seconds(self) -> None:
        scenario = with_overrides(FLAPPER, delay={"samples": 3, "seconds": 0.0007})
        assert scenario.delay_ns == 3 * 4_000_000 + 700_000


class TestGains:
    """Tables that the laws declare: read as the struct of a law, kept as the file has them."""

    class Mine(Table, frozen=True):
        stiffness: Positive6
        eager: bool = False

    def test_a_table_is_read_as_its_law_declares_it(self) -> None:
        scenario = replace_gains(FLAPPER, "mine", stiffness=(1, 2, 3, 4, 5, 6))
        assert scenario.read_gains("mine", self.Mine) == self.Mine(stiffness=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
        assert "eager" not in scenario.to_toml(), "what the file left to its default is left to it"

    @pytest.mark.parametrize(
        ("gains", "sentence"),
        [
            ({}, "the key 'gains.mine.stiffness' is missing: add it"),
            ({"stifness": (1.0,) * 6}, "unknown key 'gains.mine.stifness': did you mean 'stiffness'?"),
            ({"stiffness": (1.0,) * 5 + (0.0,)}, "gains.mine.stiffness[5]: expected float > 0.0: change this value"),
        ],
    )
    def test_what_is_wrong_is_named_with_its_place(self, gains: dict[str, Any], sentence: str) -> None:
        scenario = replace_gains(FLAPPER, "mine", **gains)
        for source, named in ((None, "scenario flapper"), (Path("my.toml"), "my.toml")):
            with pytest.raises(ScenarioError) as caught:
                scenario.read_gains("mine", self.Mine, source)
            assert str(caught.value) in (f"{named}: {sentence}", f"{named}, {sentence}")

    def test_gains_are_replaced_in_a_copy(self) -> None:
        other = replace_gains(FLAPPER, "ude", K=(7.0,) * 6)
        assert other.gains["ude"] == {"K": [7.0] * 6, "Lambda": FLAPPER.gains["ude"]["Lambda"]}
        assert {**other.gains, "ude": FLAPPER.gains["ude"]} == FLAPPER.gains == FULL["gains"]

    def test_a_file_of_before_gains_had_tables_is_still_read(self) -> None:
        """Such as the scenario.toml in a run folder of then: all of them stood in [control]."""
        gains = FULL["gains"]
        old = changed("gains", MISSING)
        old["control"] = {**gains["ude"], "b": FULL["control"]["b"], **gains["filters"], **gains["pd"]} | FULL[
            "control"
        ]
        assert parse(old) == FLAPPER

    def test_a_gain_in_both_places_is_refused(self) -> None:
        assert "unknown key 'control.K'" in refusal(changed("control.K", [1.0] * 6))


class TestNotToml:
    @pytest.mark.parametrize(
        "text",
        ["name = ", "name", "[body", 'name = "a"\nname = "b"', "\ufeffname = 'a'", "a = " + "1" * 5000]
        + ["a = " + "[" * 5000, "a = 2020-13-45", "a = '''"],
    )
    def test_what_is_no_toml_is_refused_with_the_place(self, text: str) -> None:
        with pytest.raises(ScenarioError, match=f"^{SOURCE} is not valid TOML: .+"):
            parse_scenario(text, SOURCE)

    def test_an_error_names_its_line(self) -> None:
        with pytest.raises(ScenarioError, match="line 3"):
            parse_scenario('name = "a"\n\n = 5\n', SOURCE)

    def test_an_empty_file_lacks_its_first_key(self) -> None:
        with pytest.raises(ScenarioError, match=f"^{SOURCE}: the key 'name' is missing: add it$"):
            parse_scenario("", SOURCE)

    @settings(max_examples=60)
    @given(st.sampled_from(sorted(LEAVES)), st.floats() | st.integers() | st.text() | st.lists(st.floats(), max_size=7))
    def test_any_value_anywhere_is_taken_or_refused_in_one_line(self, key: str, value: object) -> None:
        document = changed(key, value)
        came = attempt(lambda: parse(document))
        if isinstance(came, str):
            # The key named may be another: lower limits of zero refuse the initial command.
            assert came.startswith(SOURCE)
            assert ": " in came
            assert "\n" not in came
        else:
            assert parse_scenario(came.to_toml(), SOURCE) == came


class TestDigest:
    @pytest.mark.parametrize(
        "changes",
        [
            {"rate_hz": 500.0},
            {"substep_s": 0.001},
            {"duration_s": 3.0},
            {"seed": 77},
            {"law": "pd"},
            {"rate_hz": 1000.0, "substep_s": 0.001, "duration_s": 0.5, "seed": 0, "law": ""},
        ],
    )
    def test_what_one_end_may_choose_for_itself_does_not_count(self, changes: dict[str, Any]) -> None:
        other = with_overrides(FLAPPER, **changes)
        assert other != FLAPPER
        assert other.digest() == FLAPPER.digest()

    @pytest.mark.parametrize(
        "key", sorted(LEAVES.keys() - CHOSEN_BY_THE_COMMAND_LINE - OF_THE_DRIVES - {"hysteresis.model"})
    )
    def test_everything_else_counts_to_the_last_element(self, key: str) -> None:
        def other(value: Any) -> Any:
            if isinstance(value, bool):
                return not value
            if isinstance(value, str):
                return value + "2"
            if isinstance(value, int):
                return value + 1
            # Kept within the limits: kappa below h, and the scale at least the limits.
            return value * (1.01 if key in ("hysteresis.h", "actuators.scale") else 0.99) if value else 1e-6

        changed_scenario = parse(changed(key, last_changed(LEAVES[key], other)))
        assert changed_scenario.digest() != FLAPPER.digest()

    @pytest.mark.parametrize("name", sorted(OF_THE_DRIVES))
    def test_what_is_of_the_drives_counts_for_them_alone(self, name: str) -> None:
        value = {"motor.protocol": "mit", "motor.mit_reply_bytes": 6, "motor.bus_delay": True, "motor.bitrate": 250_000}
        other = value.get(name) or last_changed(LEAVES[name], lambda number: number + 1)
        changed_scenario = parse(changed(name, other))
        assert changed_scenario.digest() == FLAPPER.digest()
        assert changed_scenario.drive_digest() != FLAPPER.drive_digest()

    def test_scenarios_keep_the_digests_they_had(self) -> None:
        """Written down when the gains of a law got a table of their own: other versions of either end still agree."""
        had = {"flapper": "a8cabc79d278b804", "paper": "c87fc430c41b132b", "paper_disturbed": "499bdc41dc218586"}
        assert {file.stem: load_scenario(file).digest().hex() for file in FILES if file.stem in had} == had

    def test_gains_count_as_numbers_whoever_knows_them(self) -> None:
        """An emulator, which knows no law, must come to the same as the controller."""
        whole = parse_scenario(tomli_w.dumps(changed("gains.ude.K", [20, 20, 20, 40, 40, 40])), SOURCE)
        assert whole.digest() == FLAPPER.digest()
        for key, value in (("gains.mine", {"a": 1.0}), ("gains.ude.k", 1.0), ("gains.ude.K", [10**400])):
            assert parse_scenario(tomli_w.dumps(changed(key, value)), SOURCE).digest() != FLAPPER.digest()

    def test_a_lag_shorter_than_the_torque_loop_is_refused(self) -> None:
        assert "lag_s" in refusal(changed("motor.lag_s", 1e-5))
        assert parse(changed("motor.lag_s", 0.0)).motor.lag_s == 0.0

    def test_the_kind_of_hysteresis_counts(self) -> None:
        play = changed("hysteresis", {"model": "play", "h": [1.0] * 6, "B": [0.0] * 6})
        assert parse(play).digest() != FLAPPER.digest()

    def test_the_smallest_step_of_a_number_counts(self) -> None:
        mass = math.nextafter(FLAPPER.body.mass, 1.0)
        assert parse(changed("body.mass", mass)).digest() != FLAPPER.digest()

    def test_layout_comments_and_written_defaults_do_not_count(self) -> None:
        shuffled = {key: FULL[key] for key in reversed(FULL)}
        assert parse_scenario("# mine\n" + tomli_w.dumps(shuffled), SOURCE).digest() == FLAPPER.digest()

    def test_it_is_eight_bytes_and_differs_between_scenarios(self) -> None:
        digests = {load_scenario(file).digest() for file in FILES}
        assert {len(digest) for digest in digests} == {8}
        assert len(digests) == len(FILES)


class TestExtending:
    """A file that holds only what differs from another."""

    @staticmethod
    def load(folder: Path, text: str) -> Scenario:
        (folder / "base.toml").write_text(tomli_w.dumps(FULL))
        (folder / "mine.toml").write_text(text)
        return load_scenario(folder / "mine.toml")

    def test_what_a_file_does_not_say_is_as_in_the_other(self, tmp_path: Path) -> None:
        mine = self.load(tmp_path, 'extends = "base.toml"\nseed = 9\n[body]\nmass = 0.0057\n')
        assert mine == parse(changed("body.mass", 0.0057, changed("seed", 9)))

    def test_a_file_that_says_nothing_is_the_other(self, tmp_path: Path) -> None:
        assert self.load(tmp_path, 'extends = "base.toml"').digest() == FLAPPER.digest()

    def test_a_file_may_extend_one_that_extends_another(self, tmp_path: Path) -> None:
        (tmp_path / "middle.toml").write_text('extends = "base.toml"\nseed = 9\nlaw = "pd"')
        mine = self.load(tmp_path, 'extends = "middle.toml"\nseed = 10\n')
        assert mine == with_overrides(FLAPPER, seed=10, law="pd")

    def test_another_kind_of_hysteresis_takes_nothing_from_the_first(self, tmp_path: Path) -> None:
        table = tomli_w.dumps({"hysteresis": {"model": "play", "h": [1.0] * 6, "B": [0.1] * 6}})
        mine = self.load(tmp_path, f'extends = "base.toml"\n{table}')
        assert mine.hysteresis == Play(h=(1.0,) * 6, B=(0.1,) * 6)

    def test_the_same_kind_of_hysteresis_takes_what_is_not_said(self, tmp_path: Path) -> None:
        for model in ("", 'model = "backlash"\n'):
            mine = self.load(tmp_path, f'extends = "base.toml"\n[hysteresis]\n{model}h = {[2.0] * 6}')
            assert mine.hysteresis == parse(changed("hysteresis.h", [2.0] * 6)).hysteresis

    @pytest.mark.parametrize(
        "base", ['"mine.toml"', '"./mine.toml"', '"../{folder}/mine.toml"', "3", "[]", '["base.toml"]']
    )
    def test_a_circle_and_what_names_no_file_are_refused(self, tmp_path: Path, base: str) -> None:
        with pytest.raises(ScenarioError, match=r"mine\.toml, extends: name one other scenario file"):
            self.load(tmp_path, f"extends = {base.format(folder=tmp_path.name)}")

    def test_a_file_to_extend_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError, match=f"cannot read the scenario {tmp_path}/bsae.toml: No such file"):
            self.load(tmp_path, 'extends = "bsae.toml"')

    def test_a_bad_key_is_named_with_the_file(self, tmp_path: Path) -> None:
        with pytest.raises(ScenarioError, match=r"mine\.toml: unknown key 'body.mas': did you mean 'mass'?"):
            self.load(tmp_path, 'extends = "base.toml"\n[body]\nmas = 1.0')


class TestOverrides:
    def test_none_changes_nothing(self) -> None:
        assert with_overrides(FLAPPER) == FLAPPER
        assert with_overrides(FLAPPER, rate_hz=None, seed=None, law=None, duration_s=None) == FLAPPER

    def test_a_key_is_replaced_and_the_rest_stays(self) -> None:
        other = with_overrides(FLAPPER, seed=5, law=None)
        assert other.seed == 5
        assert with_overrides(other, seed=FLAPPER.seed) == FLAPPER
        assert FLAPPER.seed == FULL["seed"]

    @pytest.mark.parametrize(
        ("changes", "named"),
        [
            ({"rate_hz": 333.0}, "rate_hz 333"),
            ({"rate_hz": -1.0}, "rate_hz"),
            ({"seed": -1}, "seed"),
            ({"duration_s": math.nan}, "duration_s"),
            ({"rate_hz": 800.0}, "substep_s 0.0005 does not divide the period"),
            ({"rte_hz": 500.0}, "did you mean 'rate_hz'?"),
        ],
    )
    def test_a_bad_one_is_refused_and_the_command_line_named(self, changes: dict[str, Any], named: str) -> None:
        with pytest.raises(ScenarioError) as caught:
            with_overrides(FLAPPER, **changes)
        assert str(caught.value).startswith("the command line")
        assert named in str(caught.value)
