"""The command line of `fwav-hil replay`."""

from __future__ import annotations

from pathlib import Path

import click

from bridge.command_line import begin_process, json_option, law_option, options, realtime_option, wait_option
from bridge.summary import is_stdout, show_json, write_json
from protocol.errors import Interrupted, RunFolderError, UsageError

EXAMPLE = """
\b
Example:
  fwav-hil replay flight.tlog --to udpout://127.0.0.1:14550 --speed 2 --from 10 --to 60
  fwav-hil replay runs/flapper-ude-2026-11-22T14-05-09 --into controller --fast
  fwav-hil replay runs/flapper-ude-2026-11-22T14-05-09 --into controller --law pd
"""
DIFFERENT = 1
"""Exit code where a replay, or the other log, differs."""
SLOWEST, FASTEST = 0.1, 100.0


def _speed(_context: click.Context, _option: click.Parameter, text: str) -> float | None:
    """A factor, or None for `max`."""
    if text == "max":
        return None
    try:
        factor = float(text)
    except ValueError:
        factor = -1.0
    if not SLOWEST <= factor <= FASTEST:
        raise click.BadParameter(f"{text} is no speed: write a number from {SLOWEST:g} to {FASTEST:g}, or max")
    return factor


@click.command("replay", epilog=EXAMPLE)
@options(
    click.argument("log", type=click.Path(exists=True, path_type=Path)),
    click.option(
        "--to", "targets", multiple=True, metavar="URI|TIME",
        help="A link (it holds '://'): send the frames there. A time: where to end, as --from.",
    ),
    click.option(
        "--into", type=click.Choice(["controller", "emulator"]),
        help="Give a controller the recorded samples, or a plant the recorded commands, and compare what comes of it.",
    ),
    click.option(
        "--from", "begin", metavar="TIME", help="Where to begin: seconds since the log began, or HH:MM:SS (UTC).",
    ),
    click.option(
        "--speed", callback=_speed, default="1", show_default=True, metavar="X|max",
        help="Of log time: 0.1 to 100, or max, as fast as it goes.",
    ),
    click.option("--types", multiple=True, metavar="NAME,...", help="Only these messages."),
    click.option("--system", "systems", multiple=True, metavar="ID[/COMPONENT]", help="Only what these sent."),
    click.option("--loop", is_flag=True, help="Begin again at the end, until Ctrl-C."),
    click.option(
        "--max-gap", "max_gap_s", type=click.FloatRange(min=0.0), metavar="S", help="Shorten longer silences to this.",
    ),
    click.option(
        "--rewrite-time", is_flag=True,
        help="Move the messages' own times: those since 1970 begin now, those since boot at zero.",
    ),
    click.option(
        "--signing-key", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
        help="Sign every frame with this key: 64 hexadecimal digits, or 32 bytes.",
    ),
    realtime_option,
    law_option,
    click.option(
        "--scenario", metavar="SCENARIO", help="Scenario of the log, instead of the one in the log's folder (--into).",
    ),
    click.option("--fast", is_flag=True, help="Replay within this process, without a link (--into)."),
    click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR",
        help="Folder for the report of a difference; by default a new one in runs/ (--into).",
    ),
    click.option("--plots/--no-plots", default=True, show_default=True, help="Draw a difference (PNG; --into)."),
    wait_option,
    json_option,
)  # fmt: skip
def replay_command(
    log: Path,
    targets: tuple[str, ...],
    into: str | None,
    begin: str | None,
    speed: float | None,
    types: tuple[str, ...],
    systems: tuple[str, ...],
    loop: bool,
    max_gap_s: float | None,
    rewrite_time: bool,
    signing_key: Path | None,
    realtime: bool,
    law: str | None,
    scenario: str | None,
    fast: bool,
    out: Path | None,
    plots: bool,
    wait_s: float,
    json_path: Path | None,
) -> int:
    """Replay LOG (a telemetry log, or a run folder): to a link, or into a controller or an emulator.

    To a link, on a terminal: space holds and goes on, n sends one frame, the arrow keys seek, q ends.

    \b
    Exit codes with --into: 0 no difference, 1 a difference; others as ever.
    """
    uris = [target for target in targets if "://" in target]
    ends = [target for target in targets if "://" not in target]
    if len(uris) > 1 or len(ends) > 1 or (len(uris) == 1) == (into is not None):
        raise UsageError(
            "say where to replay once: --to URI (and --to TIME for the end), or --into controller|emulator"
        )
    of_links = {
        "--from": begin, "--to TIME": ends, "--speed": speed != 1.0, "--types": types, "--system": systems, "--loop": loop,
        "--max-gap": max_gap_s is not None, "--rewrite-time": rewrite_time, "--signing-key": signing_key,
    }  # fmt: skip
    of_ends = {"--law": law, "--scenario": scenario, "--fast": fast, "--out": out, "--no-plots": not plots}
    if misplaced := [name for name, given in (of_links if into else of_ends).items() if given]:
        right, wrong = ("to a link (--to URI)", "--into") if into else ("--into controller|emulator", "to a link")
        raise UsageError(f"{', '.join(misplaced)}: for replays {right}, of no effect {wrong}: leave it out")
    if realtime and (into or speed is None):
        raise UsageError(
            "--realtime is about keeping the time of a log on its way to a link: leave out --into, --speed max"
        )
    if into:
        return _replay_into(
            log, into, law=law, scenario=scenario, fast=fast, out=out, plots=plots, wait_s=wait_s, json_path=json_path
        )
    from fwav_hil.logs.choice import choose, choose_frames, open_telemetry
    from fwav_hil.replay.to_link import ReplayOptions, replay_to

    report, stop = begin_process("text", None, with_parent=False)
    opened, scan = open_telemetry(log)
    chosen = choose_frames(opened, scan, choose(opened, types, systems, begin, ends[0] if ends else None))
    how = ReplayOptions(
        speed=speed, loop=loop, max_gap_s=max_gap_s, rewrite_time=rewrite_time, signing_key=signing_key,
        realtime=realtime, wait_s=wait_s,
    )  # fmt: skip
    result = replay_to(scan, chosen, uris[0], how, report, stop)
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


def _replay_into(
    log: Path,
    into: str,
    *,
    law: str | None,
    scenario: str | None,
    fast: bool,
    out: Path | None,
    plots: bool,
    wait_s: float,
    json_path: Path | None,
) -> int:
    from bridge.process import StopFlag
    from fwav_hil.compile import compile_kernels
    from fwav_hil.replay.recorded_run import recorded_run
    from fwav_hil.replay.replay_result import plot_difference, print_difference

    stop = StopFlag()
    stop.install()
    run = recorded_run(log, scenario, law)
    if into == "controller":
        from fwav_hil.replay import into_controller as end
    else:
        from fwav_hil.replay import into_emulator as end  # type: ignore[no-redef]
    compile_kernels(run.scenario)
    difference = end.replay_in_process(run) if fast else end.replay_into_process(run, wait_s, stop)
    title = f"{run.log} into {into} ({run.scenario.name}, law {run.scenario.law})"
    result = {
        "log": str(run.log), "into": into, "scenario": run.scenario.name, "law": run.scenario.law,
        "clock": "lockstep" if run.lockstep else "realtime", "difference": not difference.is_zero,
        **difference.figures(),
    }  # fmt: skip
    print_difference(difference, title, to_stderr=is_stdout(json_path))
    if not difference.is_zero and len(difference.t_ns):
        folder = _report_folder(out, f"replay-{run.scenario.name}-{run.scenario.law}")
        if plots:
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
        raise RunFolderError(f"{folder} holds a report already, which stays: choose another folder with --out")
    make_folder(folder)
    return folder
