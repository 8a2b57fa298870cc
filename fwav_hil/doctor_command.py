"""`fwav-hil doctor`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import click

from bridge.options import Option, command
from bridge.shared_options import JsonPath
from bridge.summary import is_stdout, show_json

if TYPE_CHECKING:
    from bridge.timing.machine import Finding
    from bridge.timing.realtime import Settings
    from bridge.timing.wake_up import Trial

RATES_HZ = (250.0, 500.0, 1000.0)
UNKEPT_EXIT_CODE = 1


@command("doctor", "fwav-hil doctor --rate 500 --seconds 10 --json machine.json")
def doctor(
    seconds: Annotated[
        float, Option("--seconds", "Length of each trial; there are two for each rate.", "S", min=0.1)
    ] = 5.0,
    rates_hz: Annotated[tuple[float, ...], Option(
        "--rate", "A rate to try; may be given several times.", "HZ", min=1.0, max=100_000.0
    )] = RATES_HZ,
    json_path: JsonPath = None,
) -> int:  # fmt: skip
    """Test which rates this machine keeps in real time, and show how to improve it.

    Each rate is tried for some seconds by a process that only waits for its periods, first as an ordinary process, then with
    everything that --realtime requests. A rate counts as kept if the 99.9th percentile of the lateness is within a tenth of
    the period and no period is missed. No lasting change is made to the system.

    \b
    Exit code: 0 where every rate is kept with --realtime, else 1.
    """
    from bridge.timing.clock import MonotonicClock
    from bridge.timing.machine import Machine
    from bridge.timing.realtime import own_core
    from bridge.timing.wake_up import try_wake_ups

    findings = Machine().findings()
    trials: list[Trial] = []
    settings: Settings = ()
    for rate_hz in rates_hz:
        for realtime in (False, True):
            # One line instead of a progress bar: the bar's thread would disturb the measurement.
            click.echo(f"waking at {rate_hz:g} Hz for {seconds:g} s, {_how(realtime=realtime)} ...", err=True)
            trial, said = try_wake_ups(MonotonicClock(), rate_hz, seconds, own_core(0), realtime=realtime)
            trials.append(trial)
            settings = said or settings
    verdicts = [verdict(*trials[at : at + 2]) for at in range(0, len(trials), 2)]
    _print(findings, settings, trials, verdicts, to_stderr=is_stdout(json_path))
    kept = all(trial.keeps for trial in trials if trial.realtime)
    show_json(
        json_path,
        {"kept": kept, "findings": findings, "realtime": settings, "trials": trials, "verdicts": verdicts},
    )
    return 0 if kept else UNKEPT_EXIT_CODE


def verdict(without: Trial, with_it: Trial) -> str:
    """One line on one rate, such as "1 kHz: yes with --realtime, p99.9 60 us; no without, p99.9 900 us"."""
    rate_hz = without.rate_hz
    rate = f"{rate_hz / 1000:g} kHz" if rate_hz >= 1000 else f"{rate_hz:g} Hz"
    return f"{rate}: {_judged(with_it)} with --realtime, {_figures(with_it)}; {_judged(without)} without, {_figures(without)}"


def _judged(trial: Trial) -> str:
    return "yes" if trial.keeps else "no"


def _figures(trial: Trial) -> str:
    missed = f" and {trial.missed} of {trial.wake_ups} periods missed" if trial.missed else ""
    return f"p99.9 {trial.lateness_us['p999']:.{0 if trial.lateness_us['p999'] >= 10 else 1}f} us{missed}"


def _how(*, realtime: bool) -> str:
    return "with --realtime" if realtime else "as an ordinary process"


def _print(
    findings: list[Finding], settings: Settings, trials: list[Trial], verdicts: list[str], *, to_stderr: bool
) -> None:
    from rich.table import Table

    from fwav_hil.tables import plain_console

    console = plain_console(to_stderr=to_stderr)
    marks = {True: "good", False: "bad", None: "-"}
    table = Table("", "found", "", title="This machine", title_justify="left")
    for finding in findings:
        table.add_row(finding.name, finding.found, marks[finding.good])
    console.print(table)
    table = Table("--realtime requests", "granted", "", title="What the system grants", title_justify="left")
    for setting in settings:
        table.add_row(setting.name, "yes" if setting.granted else "no", setting.said)
    console.print(table)
    table = Table("wake-ups late by, us", title="Trials", title_justify="left")
    for column in ("p50", "p99", "p99.9", "max", "periods missed", "polled"):
        table.add_column(column, justify="right")
    for trial in trials:
        late = trial.lateness_us
        table.add_row(
            f"{trial.rate_hz:g} Hz, {_how(realtime=trial.realtime)}",
            *(f"{late[key]:.1f}" for key in ("p50", "p99", "p999", "max")),
            str(trial.missed),
            f"{late['spin']:.0f}",
        )
    console.print(table)
    remedies = [(finding.name, finding.remedy) for finding in findings if finding.remedy]
    remedies += [(setting.name, setting.remedy) for setting in settings if setting.remedy]
    if remedies:
        console.print("To improve it:")
    for name, remedy in dict(remedies).items():
        console.print(f"  {name}: {remedy}")
    for line in verdicts:
        console.print(line)
