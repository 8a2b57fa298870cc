"""What all command lines of the project share: how errors end a command, and how status is shown to the user."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

import click

from bridge.extras import remedy
from bridge.process import StopFlag
from bridge.reporting import Report
from protocol.errors import FwavHilError, Interrupted, RunFolderError, UsageError


def refuse_rate_that_cannot_fit(uri: str, rate_hz: float) -> None:
    """Raise UsageError where a serial line is too slow for the messages at a rate; other links are not checked."""
    from bridge.links.link import Medium, scheme_of  # not needed for a command's help

    if scheme_of(uri).medium is Medium.SERIAL:
        from bridge.latency.budget import link_budget

        budget = link_budget(uri, rate_hz)
        if not budget.fits:
            raise UsageError(budget.sentence)


def begin_process() -> tuple[Report, StopFlag]:
    """Install the signal handlers that stop this process cleanly; returns its report function and its stop flag."""
    stop = StopFlag()
    stop.install()
    return _report_text, stop


def _report_text(event: dict[str, Any]) -> None:
    kind = event["event"]
    if kind == "waiting":
        click.echo(f"waiting on {event['link']}", err=True)
    elif kind == "realtime":
        for setting in event["settings"]:
            remedy = f" (remedy: {setting.remedy})" if setting.remedy else ""
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
        # The reader of our output has closed it: click and rich then exit with 1. Flushing at exit must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ModuleNotFoundError as error:
        if (sentence := remedy(error)) is None:
            raise
        click.echo(f"{name}: {sentence}", err=True)
        return UsageError.exit_code
    except OSError as error:
        # Errors of files were converted before; this one is from standard output, for example on a full disk.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        click.echo(f"{name}: cannot write the output: {error.strerror or error}", err=True)
        return RunFolderError.exit_code
    return result if isinstance(result, int) else 0
