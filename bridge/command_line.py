"""What all command lines of the project share: options, how errors end a command, how status reaches a user."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import click

from bridge.option_types import FiniteRange
from bridge.process import StopFlag, end_with_parent, sit_on_core
from bridge.reporting import Report, report_json
from protocol.errors import FwavHilError, Interrupted, RunFolderError, UsageError
from protocol.scenario import Scenario, find_scenario, load_scenario, with_overrides

Command = TypeVar("Command", bound=Callable[..., Any])
DEFAULT_SCENARIO = "flapper"
DEFAULT_PORT = 14560


def options(*decorators: Callable[[Any], Any]) -> Callable[[Command], Command]:
    """Several click decorators as one, listed in the order of `--help`."""

    def decorate(function: Command) -> Command:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


scenario_argument = click.argument("scenario", default=DEFAULT_SCENARIO)
rate_option = click.option("--rate", type=float, metavar="HZ", help="Control rate instead of the scenario's.")
duration_option = click.option(
    "--duration", type=float, metavar="S", help="Length of the run instead of the scenario's."
)
seed_option = click.option("--seed", type=click.IntRange(min=0), help="Seed of the noise instead of the scenario's.")
law_option = click.option(
    "--law",
    metavar="LAW",
    help="Law instead of the scenario's, such as ude, pd or dob; an unknown name is answered with the list of all.",
)
clock_option = click.option(
    "--clock", type=click.Choice(["lockstep", "realtime"]), default="lockstep", show_default=True,
    help="lockstep: simulation time waits for every answer, so the result is the same everywhere. realtime: wall time.",
)  # fmt: skip
wait_option = click.option(
    "--wait", "wait_s", type=FiniteRange(min=0.1), default=30.0, show_default=True, metavar="S",
    help="How long to wait for the other end to appear.",
)  # fmt: skip
log_error_option = click.option(
    "--on-log-error", type=click.Choice(["stop", "continue"]), default="stop", show_default=True,
    help="Where the disk is full or cannot be written: end with what was recorded, or go on without a complete log.",
)  # fmt: skip
json_option = click.option(
    "--json", "json_path", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
    help="Write the result as JSON to this file as well ('-': standard output; the table then goes to standard error).",
)  # fmt: skip


class DurationNs(click.ParamType[int]):
    """A time with its unit, such as 5ms, 250us or 0.1s, up to a second as a scenario's delay; gives whole nanoseconds."""

    name = "time"
    _UNITS: ClassVar[dict[str, float]] = {"ns": 1.0, "us": 1e3, "ms": 1e6, "s": 1e9}
    _LONGEST_NS = 1_000_000_000

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Nanoseconds of a text, or fail with the sentence that names the remedy."""
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"(\d+\.?\d*|\.\d+)(ns|us|ms|s)", value.strip(), re.ASCII)
        if not match:
            self.fail(f"{value!r} is no time: write a number and its unit, such as 5ms, 250us or 0.1s", param, ctx)
        time_ns = float(match[1]) * self._UNITS[match[2]]
        if time_ns > self._LONGEST_NS:
            self.fail(f"{value!r} is more than a second, with which nothing flies: write a shorter time", param, ctx)
        return round(time_ns)


delay_option = click.option(
    "--delay", "delay_ns", type=DurationNs(), default=0, metavar="TIME",
    help="Real time: let every command arrive later by so much wall time, such as 5ms.",
)  # fmt: skip
legs_option = click.option(
    "--legs", is_flag=True,
    help="Real time: note when each sample and command was where, in the run folder; see `fwav-hil latency`.",
)  # fmt: skip
realtime_option = click.option(
    "--realtime", is_flag=True,
    help="In real time: ask for SCHED_FIFO, locked memory, a core of its own, no deep idle states, timer slack "
    "1 ns, no garbage collection, and poll the end of each wait; what the system refuses is said.",
)  # fmt: skip
trigger_option = click.option(
    "--trigger", type=click.Choice(["sample", "clock"]), default="sample", show_default=True,
    help="With --clock realtime the controller steps on each sample as it comes, or on a clock of its own with the "
    "newest one.",
)  # fmt: skip
spin_option = click.option(
    "--spin-us", type=click.IntRange(min=0), metavar="US",
    help="Poll this long instead of what is measured at the start: in real time before each deadline, in lockstep for "
    "each answer.",
)  # fmt: skip

station_option = click.option(
    "--station", metavar="URI",
    help="A ground station's link, besides the loop's: udpout://127.0.0.1:14550, udpin://, tcpin:// (docs/station.md).",
)  # fmt: skip
signing_option = click.option(
    "--signing-key", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
    help="Sign all that is said on the loop's link and believe only what is signed with this key: 64 hex digits or 32 bytes.",
)  # fmt: skip
truth_option = click.option(
    "--truth", "truth_hz", type=click.FloatRange(min=0.1), metavar="HZ",
    help="Say the true state on the link, and so in the log, at this rate: HIL_STATE_QUATERNION and ODOMETRY.",
)  # fmt: skip

process_options = options(
    click.option("--status", type=click.Choice(["text", "jsonl"]), default="text", hidden=True),
    click.option("--core", type=int, hidden=True),
    click.option("--with-parent", is_flag=True, hidden=True),
)


def signing_key_of(path: Path | None) -> bytes | None:
    """The key in a file, or None where none is named. Raises UsageError."""
    if path is None:
        return None
    from protocol.wire.signing import read_key

    return read_key(path)


def chosen_scenario(name: str, **overrides: Any) -> Scenario:
    """The scenario of a name or path, with what the command line changes. Raises ScenarioError."""
    return with_overrides(load_scenario(find_scenario(name)), **overrides)


def refuse_rate_that_cannot_fit(uri: str, rate_hz: float) -> None:
    """Raise UsageError where a serial line cannot carry the contract at a rate; other links are not looked at."""
    if uri.startswith("serial://"):
        from bridge.latency.budget import link_budget

        budget = link_budget(uri, rate_hz)
        if not budget.fits:
            raise UsageError(budget.sentence)


def begin_process(status: str, core: int | None, *, with_parent: bool) -> tuple[Report, StopFlag]:
    """Set a process up for its loop: signals, core, parent; returns how it reports and how it is stopped."""
    if with_parent:
        end_with_parent()
    if core is not None:
        sit_on_core(core)
    stop = StopFlag()
    stop.install()
    return (report_json(sys.stdout) if status == "jsonl" else _report_text), stop


def _report_text(event: dict[str, Any]) -> None:
    kind = event["event"]
    if kind == "waiting":
        click.echo(f"waiting on {event['link']}", err=True)
    elif kind == "realtime":
        for setting in event["settings"]:
            remedy = f" (mend: {setting.remedy})" if setting.remedy else ""
            what = "granted" if setting.granted else "refused"
            click.echo(f"real time: {setting.name} {what}: {setting.said}{remedy}", err=True)
    elif kind == "started":
        click.echo(f"started with {event['peer']}", err=True)
    elif kind == "warning":
        click.echo(event["text"], err=True)
    elif kind == "progress" and sys.stderr.isatty():
        click.echo(f"\rt = {event['t_ns'] * 1e-9:7.2f} s", nl=False, err=True)
    elif kind == "ended":
        if sys.stderr.isatty():
            click.echo(err=True)
        counted = {name: count for name, count in event["counters"].items() if count}
        click.echo("ended; " + ", ".join(f"{name} {count}" for name, count in counted.items()), err=True)


def run_command(command: click.Command, name: str, arguments: Sequence[str] | None = None) -> int:
    """Run a click command; returns the exit code. Every error is one line on standard error, never a traceback."""
    try:
        result = command.main(args=arguments, prog_name=name, standalone_mode=False)
    except FwavHilError as error:
        click.echo(f"{name}: {error}", err=True)
        return error.exit_code
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        place = context.command_path if context else name
        click.echo(f"{place}: {error.format_message()} (see `{place} --help`)", err=True)
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo(f"{name}: interrupted", err=True)
        return Interrupted.exit_code
    except (BrokenPipeError, SystemExit) as ended:
        if isinstance(ended, SystemExit) and ended.code != 1:
            raise  # a shell asked for completions
        # Whoever read our output has left: click and rich then exit with 1. Hand the interpreter a place to flush to.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        # Files have named errors of their own; what is left is the output itself, on a full disk, say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        click.echo(f"{name}: cannot write the output: {error.strerror or error}", err=True)
        return RunFolderError.exit_code
    return result if isinstance(result, int) else 0
