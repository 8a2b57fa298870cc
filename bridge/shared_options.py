"""Options that several commands share: for a scenario, for both ends of a link, for results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import msgspec

from bridge.option_types import FILE, FOLDER, KEY_FILE, MICROSECONDS, DurationNs
from bridge.options import Argument, Option
from protocol.scenario import Scenario, find_scenario, load_scenario, with_overrides

ClockMode: TypeAlias = Literal["lockstep", "realtime"]
DEFAULT_EMULATOR_LINK = "udpin://127.0.0.1:14560"
DEFAULT_CONTROLLER_LINK = "udpout://127.0.0.1:14560"

DelayNs = Annotated[int, Option(
    "--delay", "Real time: delay every command by this much wall time, such as 5ms.", "TIME",
    type=DurationNs()
)]  # fmt: skip
JsonPath = Annotated[Path | None, Option(
    "--json",
    "Write the result as JSON to this file as well ('-': standard output; the table then goes to standard error).",
    "FILE", type=FILE
)]  # fmt: skip
LAW = Option(
    "--law",
    "Law instead of the scenario's, such as ude, pd or dob; an unknown name gives the list of all laws.",
    "LAW",
)
OnLogError = Annotated[Literal["stop", "continue"], Option(
    "--on-log-error",
    "What to do when the disk is full or cannot be written: stop, or continue with an incomplete log."
)]  # fmt: skip
Plots = Annotated[bool, Option("--plots/--no-plots", "Draw the plots (PNG).")]
RealTime = Annotated[bool, Option(
    "--realtime",
    "Real time: ask for SCHED_FIFO, locked memory, a core of its own, no deep idle states, timer slack 1 ns, no "
    "garbage collection, and poll the end of each wait; settings that the system refuses are reported."
)]  # fmt: skip
Station = Annotated[str | None, Option(
    "--station",
    "Extra link for a ground station: udpout://127.0.0.1:14550, udpin://, tcpin:// (docs/station.md).",
    "URI"
)]  # fmt: skip
WaitS = Annotated[float, Option("--wait", "How long to wait for the other end to appear.", "S", min=0.1)]


def folder_option(help: str) -> Option:
    """`--out` of a command that writes into a folder."""
    return Option("--out", help, "DIR", type=FOLDER)


class ScenarioChoice(msgspec.Struct, frozen=True, kw_only=True):
    """A scenario (a file, or the name of one that comes with the project) and the keys that a command line changes in it.

    None keeps the value of the file.
    """

    scenario: Annotated[str, Argument()] = "flapper"
    law: Annotated[str | None, LAW] = None
    rate_hz: Annotated[float | None, Option("--rate", "Control rate instead of the scenario's.", "HZ")] = None
    duration_s: Annotated[float | None, Option("--duration", "Length of the run instead of the scenario's.", "S")] = (
        None
    )
    seed: Annotated[int | None, Option("--seed", "Seed of the noise instead of the scenario's.", min=0)] = None

    @property
    def path(self) -> Path:
        """The scenario's file. Raises ScenarioError where there is none."""
        return find_scenario(self.scenario)

    def load(self) -> Scenario:
        """The scenario with these changes applied. Raises ScenarioError."""
        return with_overrides(
            load_scenario(self.path),
            law=self.law,
            rate_hz=self.rate_hz,
            duration_s=self.duration_s,
            seed=self.seed,
        )


class EndOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options that both ends of a link take.

    link     URI of this end
    spin_s   in lockstep see `Link.spin_s` (None: 0); in real time how long to poll before each deadline (None: as
             measured with `realtime`, else 0)
    legs     record time stamps of each sample and command (latency segments)
    key      signing key of the link, 32 bytes
    """

    link: Annotated[str, Option("--link", "This end of the link.", "URI")] = DEFAULT_EMULATOR_LINK
    clock: Annotated[ClockMode, Option(
        "--clock",
        "lockstep: simulation time waits for every answer, so results are reproducible. realtime: wall time."
    )] = "lockstep"  # fmt: skip
    realtime: RealTime = False
    spin_s: Annotated[float | None, Option(
        "--spin-us",
        "Poll for this long, instead of the time measured at the start: in real time before each deadline, in lockstep "
        "for each answer.", "US", type=MICROSECONDS
    )] = None  # fmt: skip
    legs: Annotated[bool, Option(
        "--legs", "Real time: record latency segments (time stamps of each sample and command) in the run folder; see "
        "`fwav-hil latency`."
    )] = False  # fmt: skip
    wait_s: WaitS = 30.0
    key: Annotated[bytes | None, Option(
        "--signing-key",
        "Sign all frames sent on the loop's link, and drop received frames not signed with this key: 64 hex digits or "
        "32 bytes.", "FILE", type=KEY_FILE
    )] = None  # fmt: skip
