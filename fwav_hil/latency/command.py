"""`fwav-hil latency`."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from bridge.extras import require
from bridge.links.link import scheme_of
from bridge.option_types import EXISTING_FOLDER
from bridge.options import Option, command, given_options
from bridge.shared_options import DelayNs, JsonPath, RealTime, ScenarioChoice, WaitS, folder_option
from bridge.summary import is_stdout, make_folder, read_json, show_json, write_json
from protocol.errors import FwavHilError, Interrupted, PeerMissingError, RunFolderError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

RESULT = "latency.json"
FREE_PORT = "udpin://127.0.0.1:0"
_ASKED_RATE_HZ, _ASKED_S = 50.0, 10.0
_MOST_HZ, _MOST_QUESTIONS = 10_000.0, 10_000_000.0


@command(
    "latency",
    "fwav-hil latency flapper --rate 500 --duration 60 --against",
    "fwav-hil latency flapper --rate 500 --delay 5ms --json delayed.json",
    "fwav-hil latency --link serial:///dev/ttyUSB0:921600 --rate 50      an autopilot, by TIMESYNC alone",
    "fwav-hil latency --from RUN --controller-from RUN_OF_THE_OTHER_HOST --out REPORT",
)
def latency(
    choice: ScenarioChoice,
    link: Annotated[str, Option(
        "--link",
        "udpin:// or tcpin://: fly the closed loop on it. Any other link: probe the peer there by TIMESYNC.", "URI"
    )] = FREE_PORT,
    delay_ns: DelayNs = 0,
    realtime: RealTime = False,
    against: Annotated[
        bool, Option("--against", "Also measure a bare UDP echo, a mavutil script and cyclictest, for comparison.")
    ] = False,
    folder: Annotated[Path | None, Option(
        "--from", "Fly nothing: report the run in this folder, flown with --legs.", "DIR", type=EXISTING_FOLDER
    )] = None,
    controller_folder: Annotated[Path | None, Option(
        "--controller-from", "With --from: the controller's folder, where it ran on another machine.", "DIR",
        type=EXISTING_FOLDER, only_with="--from"
    )] = None,
    out: Annotated[
        Path | None,
        folder_option(
            "Folder of the run, its histograms (.hgrm) and the plot; by default a new one in runs/. With --from: for "
            "histograms and plot only, instead of the run's folder."
        ),
    ] = None,
    wait_s: WaitS = 30.0,
    json_path: JsonPath = None,
) -> None:  # fmt: skip
    """Measure each latency segment between a sample and its command, in the real-time closed loop or on a real link."""
    from fwav_hil.tables import plain_console

    require("plots", "studies")
    to_stderr = is_stdout(json_path)
    terminal = (sys.stderr if to_stderr else sys.stdout).isatty()
    console = plain_console(to_stderr=to_stderr, width=None if terminal else 120)
    if folder:
        _refuse_others("with --from nothing is flown", "--from", "--controller-from", "--out", "--json")
        if out:
            if (out / RESULT).exists():
                raise RunFolderError(f"{out} already holds a latency report: choose another folder with --out")
            make_folder(out)
        _report(folder, controller_folder, None, console, json_path, out=out)
        return
    if not scheme_of(link).waits:
        asked = f"the peer at {link} is probed by TIMESYNC only"
        _refuse_others(asked, "--link", "--rate", "--duration", "--wait", "--json")
        rate_hz = _ASKED_RATE_HZ if choice.rate_hz is None else choice.rate_hz
        seconds = _ASKED_S if choice.duration_s is None else choice.duration_s
        _ask(link, rate_hz, seconds, wait_s, console, json_path)
        return
    scenario = choice.load()
    from bridge.process import StopFlag
    from controller.laws.registry import refuse_on_a_link
    from fwav_hil.compile import compile_kernels
    from fwav_hil.latency.study import LONGEST_PROBING_S, beside, closed_loop
    from fwav_hil.run import check_link
    from fwav_hil.run_folder import new_folder

    refuse_on_a_link(scenario, choice.path)
    check_link(link)
    compile_kernels(scenario)
    folder = new_folder(scenario, out)
    try:
        closed_loop(scenario, folder, link=link, delay_ns=delay_ns, wait_s=wait_s, realtime=realtime)
    except FwavHilError:
        # The run's own error is raised; its results so far are reported all the same.
        with contextlib.suppress(FwavHilError):
            _report(folder, None, {}, console, json_path)
        raise
    stop = StopFlag()
    stop.install()
    try:
        with _Bar() as told:
            found = beside(scenario.rate_hz, min(LONGEST_PROBING_S, scenario.duration_s), stop, told, against=against)
    except Interrupted:
        raise Interrupted(
            f"interrupted after the run; it is in {folder}: show it with `fwav-hil latency --from {folder}`"
        ) from None
    _report(folder, None, found, console, json_path)


def _refuse_others(why: str, *known: str) -> None:
    """Raise UsageError where an argument was given that would have no effect."""
    for flag in given_options():
        if flag not in known:
            raise UsageError(f"{why}, so {flag} has no effect: leave it out")


def _report(
    folder: Path,
    controller_folder: Path | None,
    found: dict[str, Any] | None,
    console: Console,
    json_path: Path | None,
    *,
    out: Path | None = None,
) -> None:
    """Show the latency of the run in a folder, with the comparisons found (None: those made when it was flown), and write it
    to `out`, or to that folder.
    """
    from fwav_hil.latency.analysis import LEGS, join_legs
    from fwav_hil.latency.figures import draw
    from fwav_hil.latency.study import report_of, summary_of, write_files
    from fwav_hil.latency.tables import print_report
    from fwav_hil.run_folder import FILES
    from protocol.scenario import load_scenario

    legs = join_legs(folder, controller_folder)
    scenario = load_scenario(folder / FILES["scenario"])
    report = report_of(scenario, summary_of(folder, controller_folder), legs, two_clocks=controller_folder is not None)
    if found is None:
        found = read_json(folder / RESULT).get("beside", {})
    target = out or folder
    durations = {name: legs.known(name) for name in LEGS}
    files = write_files(target, durations)
    known = legs.durations_ns["age"] >= 0
    title = f"{scenario.name}, {scenario.law}, {scenario.rate_hz:g} Hz, real time: latency segments of the loop"
    series = (legs.t_ns[known] * 1e-9, "age of the sample in the applied command", legs.durations_ns["age"][known])
    files["plot"] = str(draw(target / "latency.png", title, durations, series))
    result = {"mode": "closed_loop", **report, "beside": found, "files": {**files, "run": str(folder)}}
    write_json(target / RESULT, result)
    print_report(result, console)
    console.print(f"run folder: {folder}")
    show_json(json_path, result)


def _ask(uri: str, rate_hz: float, seconds: float, wait_s: float, console: Console, json_path: Path | None) -> None:
    """Probe the peer on the link by TIMESYNC. Raises UsageError, the link's errors, PeerMissingError, Interrupted."""
    from bridge.process import StopFlag, open_patiently
    from fwav_hil.latency.histogram import percentiles
    from fwav_hil.latency.peers import probe_time_sync
    from fwav_hil.latency.tables import print_probes

    count = rate_hz * seconds
    if not (0.0 < rate_hz <= _MOST_HZ and 1.0 <= count <= _MOST_QUESTIONS):
        raise UsageError(
            f"{rate_hz:g} TIMESYNC requests a second for {seconds:g} s are out of range: --rate is at most {_MOST_HZ:g}, and "
            f"--rate times --duration from 1 to {_MOST_QUESTIONS:g}"
        )
    count = round(count)
    stop = StopFlag()
    stop.install()
    with open_patiently(uri, wait_s, stop) as link, _Bar() as told:
        link.stamp_receives()
        result, clock = probe_time_sync(
            link, stop, rate_hz=rate_hz, count=count, told=lambda sent: told("probing", sent / count)
        )
    if clock is None:
        raise PeerMissingError(
            f"no answer from {uri} to {count} TIMESYNC requests: check that an autopilot is there and uses MAVLink 2"
        )
    shown = {
        "mode": "time_sync",
        "link": uri,
        "rate_hz": rate_hz,
        "round_trip_us": percentiles(result.from_due_ns[result.from_due_ns >= 0]),
        "from_sent_us": percentiles(result.from_sent_ns[result.from_sent_ns >= 0]),
        "lost": result.lost,
        "duplicate": result.duplicates,
        "out_of_order": result.out_of_order,
        "unknown": result.unknown,
        "clock_offset_us": clock.offset_ns / 1e3,
        "clock_offset_bound_us": clock.error_ns / 1e3,
    }
    print_probes(shown, console)
    show_json(json_path, shown)


class _Bar:
    """A progress bar on a terminal; yields a function that takes the current step and its share done."""

    def __enter__(self) -> Callable[[str, float], None]:
        from rich.console import Console
        from rich.progress import Progress

        self._progress = Progress(console=Console(stderr=True), disable=not sys.stderr.isatty())
        self._progress.start()
        task = self._progress.add_task("probing", total=1.0)
        return lambda name, share: self._progress.update(task, description=name, completed=share)

    def __exit__(self, *_ended: object) -> None:
        self._progress.stop()
