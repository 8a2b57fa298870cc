"""Options that several commands have: of a scenario, of both ends of a link, of results."""

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
    "--delay", "Real time: let every command arrive later by so much wall time, such as 5ms.", "TIME",
    type=DurationNs()
)]  # fmt: skip
JsonPath = Annotated[Path | None, Option(
    "--json",
    "Write the result as JSON to this file as well ('-': standard output; the table then goes to standard error).",
    "FILE", type=FILE
)]  # fmt: skip
LAW = Option(
    "--law",
    "Law instead of the scenario's, such as ude, pd or dob; an unknown name is answered with the list of all.",
    "LAW",
)
OnLogError = Annotated[Literal["stop", "continue"], Option(
    "--on-log-error",
    "Where the disk is full or cannot be written: end with what was recorded, or go on without a complete log."
)]  # fmt: skip
Plots = Annotated[bool, Option("--plots/--no-plots", "Draw the plots (PNG).")]
RealTime = Annotated[bool, Option(
    "--realtime",
    "In real time: ask for SCHED_FIFO, locked memory, a core of its own, no deep idle states, timer slack 1 ns, no "
    "garbage collection, and poll the end of each wait; what the system refuses is said."
)]  # fmt: skip
Station = Annotated[str | None, Option(
    "--station",
    "A ground station's link, besides the loop's: udpout://127.0.0.1:14550, udpin://, tcpin:// (docs/station.md).",
    "URI"
)]  # fmt: skip
WaitS = Annotated[float, Option("--wait", "How long to wait for the other end to appear.", "S", min=0.1)]


def folder_option(help: str) -> Option:
    """`--out` of a command that writes into a folder."""
    return Option("--out", help, "DIR", type=FOLDER)


class ScenarioChoice(msgspec.Struct, frozen=True, kw_only=True):
    """A scenario, a file or the name of one that comes with the project, and what a command line changes in it.

    None leaves a key as the file has it.
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
        """The scenario with the changes. Raises ScenarioError."""
        return with_overrides(
            load_scenario(self.path),
            law=self.law,
            rate_hz=self.rate_hz,
            duration_s=self.duration_s,
            seed=self.seed,
        )


class EndOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What both ends of a link are told alike.

    link     URI of this end
    spin_s   in lockstep see `Link.spin_s` (None: 0); in real time how long to poll before what is due (None: as measured,
             with `realtime`, else 0)
    legs     note when each sample and command was where
    key      of signatures on the link, 32 bytes
    """

    link: Annotated[str, Option("--link", "This end of the link.", "URI")] = DEFAULT_EMULATOR_LINK
    clock: Annotated[ClockMode, Option(
        "--clock",
        "lockstep: simulation time waits for every answer, so the result is the same everywhere. realtime: wall time."
    )] = "lockstep"  # fmt: skip
    realtime: RealTime = False
    spin_s: Annotated[float | None, Option(
        "--spin-us",
        "Poll this long instead of what is measured at the start: in real time before each deadline, in lockstep for "
        "each answer.", "US", type=MICROSECONDS
    )] = None  # fmt: skip
    legs: Annotated[bool, Option(
        "--legs", "Real time: note when each sample and command was where, in the run folder; see `fwav-hil latency`."
    )] = False  # fmt: skip
    wait_s: WaitS = 30.0
    key: Annotated[bytes | None, Option(
        "--signing-key",
        "Sign all that is said on the loop's link and believe only what is signed with this key: 64 hex digits or 32 "
        "bytes.", "FILE", type=KEY_FILE
    )] = None  # fmt: skip
