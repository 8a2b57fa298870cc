"""One run: emulator and controller as two processes on a link, watched to their end, and their results combined.

The two need a second to start. They are started first, and this process loads its own modules meanwhile.
"""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from bridge.links.link import counterpart, parse_link_uri, scheme_of
from bridge.process import StopFlag
from fwav_hil.children import Child, listen
from fwav_hil.jobs import Job
from fwav_hil.motor_child import MotorKeeper
from fwav_hil.options import RunOptions
from fwav_hil.placement import choose_placement
from fwav_hil.run_folder import FILES
from plant_emulator.options import MotorLink, MotorOptions
from protocol.errors import FwavHilError, Interrupted, PeerError, UsageError
from protocol.scenario import NANOSECONDS, Scenario

if TYPE_CHECKING:
    from fwav_hil.progress import Progress
    from fwav_hil.studies.margin import Budget


class RunFailedError(FwavHilError):
    """A process of the run failed; carries its exit code."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


_PATIENCE = 10
"""Polls, a tenth of a second apart or less, for a process to end by itself after the other one has failed."""


def check_link(uri: str) -> None:
    """Raise UsageError where a controller cannot connect to the emulator on this link."""
    if not scheme_of(uri).waits:
        raise UsageError(
            f"`run` needs a link on which the emulator waits for the controller, unlike {uri}: use "
            "udpin://host:port or tcpin://host:port, or start both ends separately"
        )
    parse_link_uri(uri)


def check_motors(scenario: Scenario, motors: MotorLink) -> None:
    """Raise UsageError, LinkUriError or RunFolderError where the options of the drives' bus cannot work.

    Called before anything is started, so that no folder is left behind.
    """
    from bridge.motor_bus.can_bus import parse_can_uri
    from bridge.motor_bus.can_load import plan_bus

    parse_can_uri(motors.can)
    plan_bus(scenario.motor.protocol, scenario.motor, scenario.rate_hz)
    if motors.tap:
        parse_link_uri(motors.tap)
    if motors.log:
        from bridge.motor_bus.can_recorder import check_record

        check_record(motors.log)


def run(scenario: Scenario, folder: Path, options: RunOptions) -> dict[str, Any]:
    """Run both processes; returns the summary, which is also in the folder. Raises RunFailedError, Interrupted, ...

    Before it flies, one line on standard error shows how much of the largest stable delay is left (`budget_line`).
    In any case the folder keeps what was recorded, no process is left running, and the summary is written if there are
    results.
    """
    check_link(options.link)
    stop = StopFlag()
    stop.install()
    placement = choose_placement(options.clock, realtime=options.realtime, spin_s=options.spin_s)
    of_emulator, of_controller = options.of_ends(folder, placement)
    emulator = Child("plant_emulator", Job(scenario, of_emulator, of_emulator.core))
    controller = Child("controller", Job(scenario, of_controller, of_controller.core))
    keeper, motors = None, of_emulator.motors
    if motors and not motors.can.startswith("virtual:"):
        keeper = MotorKeeper(Job(scenario, MotorOptions(can=motors.can, out=folder)))
    try:
        budget, progress = _while_they_get_ready(scenario, options)
        _watch(scenario, emulator, controller, keeper, stop, progress)
    finally:
        for child in (emulator, controller, *((keeper,) if keeper else ())):
            child.end()
    from fwav_hil.report import summarise

    known = msgspec.to_builtins(budget)
    summary = summarise(folder, placement=placement.text, budget=known) if _has_rows(folder) else {}
    if stop.requested:
        raise Interrupted(f"interrupted: the recording up to then is in {folder}")
    failures = [(child.failure, child.process.returncode) for child in _culprit_first(emulator, controller)]
    if keeper:
        failures.insert(0, (keeper.failure, keeper.child.process.returncode))
    for failure, code in failures:
        if failure:
            raise RunFailedError(failure, code if code > 0 else PeerError.exit_code)
    return summary


def _while_they_get_ready(scenario: Scenario, options: RunOptions) -> tuple[Budget, Progress | None]:
    """Compute the delay budget and, unless the caller does so, show it and make the progress bar."""
    from fwav_hil.studies.margin import budget_line

    budget = budget_line(scenario, options.clock)
    if not options.show_progress:
        return budget, None
    from fwav_hil.progress import Progress

    click.echo(f"{'warning: ' if budget.warn else ''}{budget.sentence}", err=True)
    return budget, Progress(scenario.duration_s)


def _watch(
    scenario: Scenario,
    emulator: Child,
    controller: Child,
    keeper: MotorKeeper | None,
    stop: StopFlag,
    progress: Progress | None,
) -> None:
    """Read the reports of all processes until they have ended, and show the progress."""
    told = False
    patience = _PATIENCE
    children = [emulator, controller, *((keeper.child,) if keeper else ())]
    with progress or nullcontext():
        for child, event in listen(children):
            kind = event.get("event")
            if keeper and not stop.requested:
                keeper.look(children, emulator)
            if child is emulator and kind == "waiting":
                told = True
                controller.tell(counterpart(event["link"]))
            elif kind == "warning":
                sys.stderr.write(event["text"] + "\n")
            elif progress and child is emulator and kind == "progress":
                progress.update(event["t_ns"] / NANOSECONDS, _error_now(scenario, event["t_ns"], event["q"]))
            elif kind in ("motors_lost", "motors_back"):
                said = "fell silent: safe output" if kind == "motors_lost" else "answer again"
                click.echo(f"t = {event['t_ns'] / NANOSECONDS:.3f} s: the drives {said}", err=True)
            failed = any(one.process.poll() for one in (emulator, controller)) or bool(keeper and keeper.failure)
            if stop.requested or failed:
                # A process that still runs ends by itself soon, or is asked to; a terminal's signals reached all of them.
                patience -= 1
                if patience == 0 or not told:
                    emulator.ask_to_end()
                    controller.ask_to_end()
                    if keeper:
                        keeper.ask_to_end()
                elif patience < -_PATIENCE:
                    return


def _error_now(scenario: Scenario, t_ns: int, q: list[float]) -> tuple[float, float]:
    """Largest position error (m) and attitude error (rad) at one time."""
    import numpy as np

    from controller.laws.reference import evaluate_reference, reference_parameters

    desired = np.empty((3, 6))
    evaluate_reference(t_ns * 1e-9, reference_parameters(scenario.reference), desired[0], desired[1], desired[2])
    error = np.abs(np.array(q) - desired[0])
    return float(error[:3].max()), float(error[3:].max())


def _culprit_first(emulator: Child, controller: Child) -> tuple[Child, Child]:
    """The process whose failure explains the other's: one that was killed, or else the emulator."""
    killed = controller.process.returncode is not None and controller.process.returncode < 0
    return (controller, emulator) if killed else (emulator, controller)


def _has_rows(folder: Path) -> bool:
    import numpy as np

    path = folder / FILES["ground_truth"]
    return path.exists() and len(np.load(path, mmap_mode="r")) > 0
