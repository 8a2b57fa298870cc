"""An option is declared once: a field of a structure is an option of every command that takes it, and of its child process."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import click
import msgspec
import pytest

from bridge.command_line import run_command
from bridge.options import Argument, Except, Option, command, given_options


class Bus(msgspec.Struct, frozen=True, kw_only=True):
    uri: Annotated[str, Option("--bus", "Where the bus is.", "URI", only_with="--drives bus")] = "can0"


class End(msgspec.Struct, frozen=True, kw_only=True):
    wait_s: Annotated[float, Option("--wait", "How long to wait.", "S", min=0.1)] = 30.0
    arm: Annotated[bool, Option("--arm/--no-arm", "Arm at once.")] = True
    core: int | None = None


class Plant(End, frozen=True, kw_only=True):
    speed: Annotated[float | None, Option("--speed", "How fast.", "X", min=0.0, min_open=True)] = None
    drives: Annotated[Literal["direct", "bus"], Option("--drives", "Where the drives are.")] = "direct"
    bus: Bus = Bus()
    out: Annotated[Path | None, Option("--out", "Where to.", "DIR")] = None


class Pilot(End, frozen=True, kw_only=True):
    gains: Annotated[tuple[float, ...], Option("--gain", "A gain.", "K")] = ()
    label: Annotated[str, Option("--label", "A name.")] = "pilot"


class Pair(End, frozen=True, kw_only=True):
    plant: Annotated[Plant, Except("out")] = Plant(core=1)
    pilot: Annotated[Pilot, Except(label=Option("--pilot-label", "The name of the pilot."))] = Pilot(core=2)


IMPATIENT = End(wait_s=1.0)
got: list[Any] = []


@command("plant", "prog plant --speed 2", "prog plant calm")
def plant_command(options: Plant, place: Annotated[str, Argument()] = "here") -> None:
    """Be a plant."""
    got[:] = [options, place, given_options()]


@command("pair", "prog pair")
def pair_command(options: Pair, count: Annotated[int, Option("--count", "How many.", "N", min=1, max=9)]) -> int:
    """Be both."""
    got[:] = [options, count]
    return count


def give(made: click.Command, *arguments: str) -> Any:
    code = run_command(made, "prog", arguments)
    return (code, *got)


class TestFilling:
    def test_a_command_gets_one_structure_with_what_was_given(self) -> None:
        _, options, place, given = give(plant_command, "--speed", "2", "--no-arm", "--out", "folder", "there")
        assert options == Plant(speed=2.0, arm=False, out=Path("folder"))
        assert place == "there"
        assert sorted(given) == ["--arm", "--out", "--speed", "PLACE"]

    def test_without_anything_it_is_the_default(self) -> None:
        assert give(plant_command) == (0, Plant(), "here", [])

    def test_an_option_of_two_parts_goes_to_both(self) -> None:
        code, options, count = give(pair_command, "--wait", "5", "--gain", "1", "--gain", "2.5", "--count", "3")
        assert code == count == 3
        assert options == Pair(
            wait_s=5.0, plant=Plant(wait_s=5.0, core=1), pilot=Pilot(wait_s=5.0, gains=(1.0, 2.5), core=2)
        )

    def test_what_is_left_out_or_renamed_is(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert give(pair_command, "--out", "x", "--count", "1")[0] == 2
        assert give(pair_command, "--label", "x", "--count", "1")[0] == 2
        _, options, _ = give(pair_command, "--pilot-label", "ada", "--count", "1")
        assert options.pilot.label == "ada"

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["--wait", "0"], "--wait"),
            (["--wait", "nan"], "--wait"),
            (["--speed", "0"], "--speed"),
            (["--drives", "none"], "'none' is not one of 'direct', 'bus'"),
            (["--bus", "can1"], "--bus has no effect without --drives bus: add it, or leave --bus out"),
            (["--core", "1"], "No such option"),
        ],
    )
    def test_what_it_cannot_be_is_refused(
        self, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        got.clear()
        assert run_command(plant_command, "prog", arguments) == 2
        assert words in capsys.readouterr().err
        assert not got

    def test_what_needs_another_option_is_taken_with_it(self) -> None:
        _, options, _, _ = give(plant_command, "--bus", "can1", "--drives", "bus")
        assert options == Plant(drives="bus", bus=Bus(uri="can1"))

    @pytest.mark.parametrize("count", [[], ["--count", "0"], ["--count", "10"], ["--count", "1.5"]])
    def test_a_parameter_without_a_default_must_be_given(self, count: list[str]) -> None:
        got.clear()
        assert run_command(pair_command, "prog", count) == 2
        assert not got


class TestHelp:
    def test_it_is_the_docstring_the_options_in_their_order_and_the_examples(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert run_command(plant_command, "prog", ["--help"]) == 0
        shown = capsys.readouterr().out
        parts = ["Be a plant.", "--wait S", "30.0; x>=0.1", "--arm / --no-arm", "[default: arm]", "--speed X", "[x>0.0]",
                 "--drives [direct|bus]", "[default: direct]", "--bus URI", "Example:\n    prog plant --speed 2\n",
                 "    prog plant calm\n"]  # fmt: skip
        places = [shown.index(part) for part in parts]
        assert places == sorted(places)
        assert "core" not in shown

    def test_into_a_group(self) -> None:
        group = click.Group("group")
        command("inner", "prog group inner", group=group)(lambda: None)
        assert list(group.commands) == ["inner"]


class TestMistakesOfOurs:
    def test_one_flag_with_two_meanings_is_refused(self) -> None:
        class Other(msgspec.Struct, frozen=True, kw_only=True):
            wait_s: Annotated[float, Option("--wait", "Something else.", "S")] = 30.0

        def both(plant: Plant, other: Other) -> None: ...

        both.__annotations__ = {"plant": Plant, "other": Other}
        with pytest.raises(TypeError, match="--wait is declared twice, in different ways"):
            command("both")(both)

    def test_one_flag_with_two_defaults_is_refused(self) -> None:
        def both(first: End, second: End = IMPATIENT) -> None: ...

        with pytest.raises(TypeError, match="--wait is declared twice"):
            command("both")(both)

    def test_a_field_that_is_not_there_cannot_be_left_out(self) -> None:
        def one(end: Annotated[End, Except("weight_s")]) -> None: ...

        with pytest.raises(TypeError, match="End has no field weight_s"):
            command("one")(one)
