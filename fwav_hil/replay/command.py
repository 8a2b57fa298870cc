"""The command line of `fwav-hil replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import click

from bridge.command_line import begin_process
from bridge.extras import left_out_if_missing
from bridge.option_types import EXISTING
from bridge.options import Argument, Option, command
from bridge.shared_options import JsonPath
from bridge.summary import is_stdout, show_json, write_json
from fwav_hil.logs.dialect_option import Dialect
from fwav_hil.replay.options import TO, IntoOptions, ReplayOptions
from protocol.errors import Interrupted, RunFolderError, UsageError

DIFFERENT = 1
"""Exit code where a replay, or a compared log, differs."""


@command(
    "replay",
    "fwav-hil replay flight.tlog --to udpout://127.0.0.1:14550 --speed 2 --from 10 --to 60",
    "fwav-hil replay runs/flapper-ude-2026-11-22T14-05-09 --into controller --fast",
    "fwav-hil replay runs/flapper-ude-2026-11-22T14-05-09 --into controller --law pd",
)
def replay_command(
    log: Annotated[Path, Argument(type=EXISTING)],
    *,
    targets: Annotated[tuple[str, ...], Option(
        "--to",
        "A link (it holds '://'), for a log of a CAN bus can:URI: send the frames there. A time: where to end, as --from.",
        "URI|TIME",
    )] = (),
    into: Annotated[Literal["controller", "emulator"] | None, Option(
        "--into",
        "Send a controller the recorded samples, or a plant the recorded commands, and compare the results."
    )] = None,
    begin: Annotated[str | None, Option(
        "--from", "Where to begin: seconds since the log began, or HH:MM:SS (UTC).", "TIME", only_with=TO
    )] = None,
    types: Annotated[tuple[str, ...], Option("--types", "Send only these messages.", "NAME,...", only_with=TO)] = (),
    systems: Annotated[
        tuple[str, ...], Option("--system", "Send only frames of these senders.", "ID[/COMPONENT]", only_with=TO)
    ] = (),
    dialect: Dialect = None,
    options: ReplayOptions,
    into_options: IntoOptions,
    json_path: JsonPath = None,
) -> int:  # fmt: skip
    """Replay LOG (a telemetry log, or a run folder): to a link, or into a controller or an emulator; a CAN log to a bus.

    To a link, on a terminal: space pauses and resumes, n sends one frame, the arrow keys seek, q ends.

    \b
    Exit codes with --into: 0 no difference, 1 a difference; others as for every command.
    """
    uris = [target for target in targets if "://" in target or target.startswith("can:")]
    ends = [target for target in targets if target not in uris]
    if len(uris) > 1 or len(ends) > 1 or (len(uris) == 1) == (into is not None):
        raise UsageError("give one target: --to URI (and --to TIME for the end), or --into controller|emulator")
    if into and ends:
        raise UsageError("--to TIME has no effect without --to URI: add that, or leave --to TIME out")
    if options.realtime and (into or options.speed is None):
        raise UsageError("--realtime applies only to a timed replay to a link: leave out --into and --speed max")
    if into:
        return _replay_into(log, into, into_options, options.wait_s, json_path)
    if uris[0].startswith("can:"):
        of_messages = {
            "--from": begin, "--to TIME": ends, "--types": types, "--system": systems, "--rewrite-time": options.rewrite_time,
            "--signing-key": options.key, "--realtime": options.realtime,
        }  # fmt: skip
        if misplaced := [name for name, given in of_messages.items() if given]:
            raise UsageError(f"{', '.join(misplaced)}: of no effect on a log of a CAN bus: leave it out")
        return _replay_to_can(log, uris[0], options, json_path)
    from fwav_hil.logs.choice import choose, choose_frames, open_telemetry
    from fwav_hil.replay.to_link import replay_to

    report, stop = begin_process()
    opened, scan = open_telemetry(log)
    chosen = choose_frames(opened, scan, choose(opened, types, systems, begin, ends[0] if ends else None))
    result = replay_to(scan, chosen, uris[0], options, report, stop)
    late = result["lateness_us"]
    shown = ", ".join(f"{name} {late[name]:.0f} us" for name in ("p50", "p99", "max") if late[name] is not None)
    click.echo(
        f"{result['frames']} frames, {result['log_s']:.1f} s of log in {result['wall_s']:.1f} s"
        + (f" ({result['speed_measured']:.4g} x)" if result["speed_measured"] else "")
        + (f", late by {shown}" if shown else ""),
        err=is_stdout(json_path),
    )
    show_json(json_path, result)
    if result["interrupted"]:
        raise Interrupted(f"interrupted after {result['frames']} frames")
    return 0


def _replay_to_can(log: Path, uri: str, options: ReplayOptions, json_path: Path | None) -> int:
    from fwav_hil.replay.to_can import replay_to_can

    _, stop = begin_process()
    result = replay_to_can(log, uri, options, stop)
    left_out = f"; left out: {result['left_out']} that no classical bus carries" if result["left_out"] else ""
    click.echo(
        f"{result['frames']} frames, {result['log_s']:.1f} s of log in {result['wall_s']:.1f} s{left_out}",
        err=is_stdout(json_path),
    )
    show_json(json_path, result)
    if result["interrupted"]:
        raise Interrupted(f"interrupted after {result['frames']} frames")
    return 0


def _replay_into(log: Path, into: str, options: IntoOptions, wait_s: float, json_path: Path | None) -> int:
    from bridge.process import StopFlag
    from fwav_hil.compile import compile_kernels
    from fwav_hil.replay.recorded_run import recorded_run
    from fwav_hil.replay.replay_result import plot_difference, print_difference

    stop = StopFlag()
    stop.install()
    run = recorded_run(log, options.scenario, options.law)
    if into == "controller":
        from fwav_hil.replay import into_controller as end
    else:
        from fwav_hil.replay import into_emulator as end  # type: ignore[no-redef]
    compile_kernels(run.scenario)
    difference = end.replay_in_process(run) if options.fast else end.replay_into_process(run, wait_s, stop)
    title = f"{run.log} into {into} ({run.scenario.name}, law {run.scenario.law})"
    result = {
        "log": str(run.log), "into": into, "scenario": run.scenario.name, "law": run.scenario.law,
        "clock": "lockstep" if run.lockstep else "realtime", "difference": not difference.is_zero,
        **difference.figures(),
    }  # fmt: skip
    print_difference(difference, title, to_stderr=is_stdout(json_path))
    if not difference.is_zero and len(difference.t_ns):
        folder = _report_folder(options.out, f"replay-{run.scenario.name}-{run.scenario.law}")
        if options.plots:
            with left_out_if_missing("plot"):
                plot_difference(difference, title, folder / "difference.png")
        write_json(folder / "difference.json", result)
        click.echo(f"report: {folder}", err=is_stdout(json_path))
    show_json(json_path, result)
    return 0 if difference.is_zero else DIFFERENT


def _report_folder(out: Path | None, name: str) -> Path:
    from bridge.summary import make_folder
    from bridge.timing.clock import local_stamp

    folder = out or Path("runs") / f"{name}-{local_stamp()}"
    if (folder / "difference.json").exists():
        raise RunFolderError(f"{folder} already holds a report: choose another folder with --out")
    make_folder(folder)
    return folder
