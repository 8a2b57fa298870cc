"""One latency study: the closed loop in real time, probes for comparison, and a simulation with the delay found."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from bridge.process import StopFlag
from bridge.summary import read_json
from fwav_hil.latency.analysis import LEGS, Legs, clock_check
from fwav_hil.latency.histogram import percentiles, write_hgrm
from fwav_hil.latency.peers import cyclictest, probe_echo, probe_mavutil, probe_responder
from fwav_hil.options import RunOptions
from fwav_hil.report import summarise
from fwav_hil.run import run
from fwav_hil.run_folder import FILES
from fwav_hil.score import scores
from fwav_hil.simulate import Simulation, simulate
from plant_emulator.options import EmulatorOptions
from protocol.scenario import NANOSECONDS, Delay, Scenario

Told = Callable[[str, float], None]
"""Called with the current step and the share of it that is done."""

LONGEST_PROBING_S = 5.0
MISSING_CYCLICTEST = "cyclictest was not found or failed: install it with `apt-get install rt-tests`"


def closed_loop(
    scenario: Scenario, folder: Path, *, link: str, delay_ns: int, wait_s: float, realtime: bool
) -> dict[str, Any]:
    """Fly the scenario in real time with time stamps; returns the run's summary. Raises what `run` raises."""
    emulator = EmulatorOptions(delay_ns=delay_ns)
    how = RunOptions(clock="realtime", link=link, wait_s=wait_s, legs=True, realtime=realtime, emulator=emulator)
    return run(scenario, folder, how)


def leg_report(legs: Legs) -> dict[str, dict[str, float | int | None]]:
    """Percentiles of every latency segment, us."""
    return {name: percentiles(legs.known(name)) for name in LEGS}


def write_files(folder: Path, durations_ns: dict[str, npt.NDArray[np.int64]]) -> dict[str, str]:
    """Write an .hgrm file for each distribution; returns name -> file."""
    files = {}
    for name, values in durations_ns.items():
        if len(values):
            path = folder / f"latency_{name}.hgrm"
            write_hgrm(path, values)
            files[f"{name}_hgrm"] = str(path)
    return files


def losses(summary: dict[str, Any]) -> dict[str, int]:
    """Lost, duplicate and reordered frames of both directions, from the counters of a run.

    Where no sample arrives in time the controller sends its last answer again, the same frame (`repeated`): this is not a
    duplicate made by the link, and not out of order.
    """
    counters = summary.get("counters", {})
    emulator, controller = counters.get("emulator", {}), counters.get("controller", {})
    repeated = controller.get("repeated", 0)
    return {
        "lost": emulator.get("sequence_gaps", 0) + controller.get("sequence_gaps", 0),
        "duplicate": max(0, emulator.get("repeated", 0) - repeated),
        "out_of_order": emulator.get("old_commands", 0) + controller.get("out_of_order", 0),
        "repeated": repeated,
        "unanswered_in_period": emulator.get("unanswered", 0),
        "missed_deadlines": emulator.get("late", 0),
        "slipped_periods": emulator.get("slipped", 0),
    }


def prediction(scenario: Scenario, legs: Legs, summary: dict[str, Any]) -> dict[str, Any] | None:
    """The tracking error that `simulate` predicts, and the run's: RMSE by axis.

    `constant`: every command delayed by the median age. `recorded`: each by its own delay in the run, in simulation time;
    a command that did not arrive never acts. Both are as long as the run was. None where a simulation diverged.
    """
    flown = np.arange(summary.get("ticks", 0)) * scenario.period_ns
    answered = np.isin(legs.t_ns, flown)
    if not answered.any():
        return None
    scenario = msgspec.structs.replace(scenario, duration_s=len(flown) * scenario.period_ns / NANOSECONDS)
    median_s = float(np.median(legs.delay_ns[answered])) / NANOSECONDS
    delayed = msgspec.structs.replace(scenario, delay=Delay(samples=0, seconds=median_s))
    delays_ns = np.full(scenario.ticks, -1, dtype=np.int64)
    delays_ns[legs.t_ns[answered] // scenario.period_ns] = legs.delay_ns[answered]
    return {
        "delay_s": median_s,
        "rmse_run": summary["rmse"],
        "rmse_constant": _rmse(delayed, simulate(delayed)),
        "rmse_recorded": _rmse(scenario, simulate(scenario, delays_ns=delays_ns)),
    }


def _rmse(scenario: Scenario, result: Simulation) -> dict[str, float | None] | None:
    if result.divergence:
        return None
    rmse: dict[str, float | None] = scores(scenario, result.t_ns, result.q)["rmse"]
    return rmse


def beside(rate_hz: float, seconds: float, stop: StopFlag, told: Told, *, against: bool) -> dict[str, Any]:
    """Open-loop probes of our own responder and, if asked, of a bare echo and a mavutil script; and cyclictest's wake-ups.

    Values are distributions in us, with the counts of answers lost, duplicate, out of order and unrequested; a note where a
    probe could not run. Raises Interrupted.
    """
    count = max(100, round(rate_hz * seconds))
    probes = {"open_loop": probe_responder}
    if against:
        probes |= {"bare_echo": probe_echo, "mavutil": probe_mavutil}
    found: dict[str, Any] = {}
    for name, ask in probes.items():
        result = ask(stop, rate_hz=rate_hz, count=count, told=lambda sent, name=name: told(name, sent / count))  # type: ignore[misc]
        known = result.from_due_ns[result.from_due_ns >= 0]
        found[name] = {
            "from_due": percentiles(known),
            "from_sent": percentiles(result.from_sent_ns[result.from_sent_ns >= 0]),
            "lost": result.lost,
            "duplicate": result.duplicates,
            "out_of_order": result.out_of_order,
            "unknown": result.unknown,
        }
    if against:
        lateness = cyclictest(
            stop, rate_hz=rate_hz, seconds=count / rate_hz, told=lambda done: told("cyclictest", done / count)
        )
        found["cyclictest"] = {"note": MISSING_CYCLICTEST} if lateness is None else {"wake": percentiles(lateness)}
    return found


def summary_of(folder: Path, controller_folder: Path | None = None) -> dict[str, Any]:
    """The summary of a run folder, computed where there is none (an emulator alone writes none), with the counters of both.

    Raises RunFolderError, ScenarioError.
    """
    summary = read_json(folder / FILES["summary"]) or summarise(folder)
    if controller_folder:
        theirs = read_json(controller_folder / FILES["controller"]).get("counters", {})
        summary["counters"] = {**summary.get("counters", {}), "controller": theirs}
    return summary


def report_of(scenario: Scenario, summary: dict[str, Any], legs: Legs, *, two_clocks: bool = False) -> dict[str, Any]:
    """The report of a run with time stamps; two_clocks: TIMESYNC relates the clocks, with no shared clock to check it."""
    return {
        "scenario": scenario.name,
        "law": scenario.law,
        "rate_hz": scenario.rate_hz,
        "duration_s": scenario.duration_s,
        "legs_us": leg_report(legs),
        "losses": losses(summary),
        "negative_legs": legs.negative,
        "time_sync": _offset_of(legs) if two_clocks else clock_check(legs),
        "prediction": prediction(scenario, legs, summary),
        "placement": summary.get("placement", ""),
    }


def _offset_of(legs: Legs) -> dict[str, Any] | None:
    """The offset of the controller's clock at the first and last sample, and the largest bound of its error; us."""
    if legs.clock is None or legs.offset_ns is None or legs.offset_error_ns is None or not len(legs.t_ns):
        return None
    return {
        "offset_us": float(legs.offset_ns[0]) / 1e3,
        "offset_at_end_us": float(legs.offset_ns[-1]) / 1e3,
        "bound_us": float(legs.offset_error_ns.max()) / 1e3,
        "answers": legs.clock.answers,
    }
