"""The emulator as a process: meet the controller, run the ticks, end cleanly, say what happened."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from bridge.clock import MonotonicClock, processor_time_ns
from bridge.endpoint import VEHICLE, Endpoint, refuse_other_scenario
from bridge.faults import DelayedLink
from bridge.legs import ANSWER_COLUMNS, CLOCK_COLUMNS, EMULATOR_FILE, TICK_COLUMNS, LegTable, save_legs
from bridge.link import Link
from bridge.memory import memory_pair
from bridge.process import Report, StopFlag, open_patiently
from bridge.rate import RateKeeper, choose_spin_ns
from bridge.realtime import Settings, has_own_core, maybe_real_time, report_settings
from bridge.ring_recorder import RingRecorder
from bridge.sidecar import LinkOfLog
from bridge.signed_link import signed
from bridge.station import open_station
from bridge.summary import make_folder, percentiles_us, refuse_existing_run, write_json, write_text
from plant_emulator.emulator import Emulator
from plant_emulator.on_request import OnRequest
from plant_emulator.pacing import Lockstep, Pacing, Parts, RealTime
from plant_emulator.tolerant import Tolerant, meet_autopilot
from plant_emulator.truth import TruthWriter
from protocol import mavlink_map
from protocol.errors import FwavHilError, PeerMissingError, RunFolderError, UsageError
from protocol.messages import ActuatorCommand
from protocol.scenario import NANOSECONDS, Scenario
from protocol.streams import Due
from protocol.tlog import TlogWriter

if TYPE_CHECKING:
    from plant_emulator.can_motors import CanMotors

STATION_FILE = "station_emulator.tlog"
HELLO_PERIOD_S = 0.1
PROGRESS_PERIOD_NS = 100_000_000
FAREWELLS = 3
"""Times the end is said, since a datagram may be lost."""


class MotorLink(msgspec.Struct, frozen=True, kw_only=True):
    """How the emulator reaches its drives.

    can: URI of the bus. feedback: "sync" (every bit of u) or "bus" (the protocol's own status). log: where the bus is
    recorded, by suffix; None: motor_bus.blf in the run folder, if there is one. tap: MAVLink link of the CAN tap.
    """

    can: str
    feedback: str = "sync"
    log: Path | None = None
    tap: str | None = None


class EmulatorOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How the process runs.

    speed: lockstep paced to that multiple of real time (None: as fast as it goes). delay_ns: real time: what comes is taken
    so much later. legs: real time: note when each tick and command was where. realtime: ask for what `bridge.realtime`
    lists, with `core` as the core to have. spin_s: in lockstep see `Link.spin_s` (None: 0); in real time how long to poll
    before each deadline (None: as measured with `realtime`, else 0).
    on_log_error: what a disk that refuses means for the run: "stop", or "continue" with what can be recorded.
    motors: where the drives are, if not in the plant itself. station: URI of a ground station's link. truth_hz: say the true
    state on the link at this rate, as if its peer had asked for it. key: of signatures on
    the loop's link. profile: of lockstep, "exact" or "tolerant".
    """

    link: str
    clock: str = "lockstep"
    speed: float | None = None
    out: Path | None = None
    wait_s: float = 30.0
    spin_s: float | None = None
    delay_ns: int = 0
    legs: bool = False
    on_log_error: str = "stop"
    realtime: bool = False
    core: int | None = None
    motors: MotorLink | None = None
    station: str | None = None
    key: bytes | None = None
    truth_hz: float | None = None
    profile: str = "exact"


def run_emulator(scenario: Scenario, options: EmulatorOptions, report: Report, stop: StopFlag) -> dict[str, Any]:
    """Open the link and `fly`. Raises the errors of `protocol.errors`."""
    if options.clock != "realtime" and (options.delay_ns or options.legs):
        raise UsageError(
            "--delay and --legs are of real time: add --clock realtime (in lockstep the delay is the scenario's, [delay])"
        )
    if options.profile == "tolerant" and (options.clock != "lockstep" or options.motors):
        raise UsageError(
            "--profile tolerant is of lockstep, with the gears in the plant: leave out --clock realtime and --motor can"
        )
    if options.legs and not options.out:
        raise UsageError("--legs needs a folder for the time stamps: add --out DIR")
    warm_up(scenario)
    with open_patiently(options.link, options.wait_s, stop) as link:
        if options.clock == "lockstep":
            link.spin_s = options.spin_s or 0.0
        if options.legs or options.delay_ns:
            link.stamp_receives()  # a delay counts from the arrival, not from when we got round to it
        delayed = DelayedLink(link, options.delay_ns, MonotonicClock()) if options.delay_ns else link
        return fly(scenario, signed(delayed, options.key), options, report, stop)


def fly(scenario: Scenario, link: Link, options: EmulatorOptions, report: Report, stop: StopFlag) -> dict[str, Any]:
    """Run a scenario against whatever controller comes to the link; returns the summary of this end.

    The log, the ground truth and this summary (in `options.out`) are complete up to the end, whatever that end is. Raises
    the errors of `protocol.errors`.
    """
    log = truth = None
    try:
        if options.out:
            refuse_existing_run(options.out)
            log, truth = _open_files(scenario, link, options, options.out, report)
        endpoint = Endpoint(link, VEHICLE[0], scenario.wire.emulator_component)
        with (
            _motors(scenario, options, report, stop) as motors,
            open_station(
                options.station,
                (endpoint.writer.system, endpoint.writer.component),
                _heartbeat,
                options.out / STATION_FILE if options.out else None,
                options.wait_s,
                stop,
            ) as station,
            maybe_real_time(options.core, wanted=options.realtime) as settings,
        ):
            emulator = Emulator(scenario, endpoint, truth, motors, station)
            if options.truth_hz:
                emulator.on_request.ask_for_truth(options.truth_hz)
            report_settings(report, settings)
            parts = Parts(emulator, endpoint, log, MonotonicClock(), stop, scenario.period_ns)
            pacing = _pacing(scenario, options, parts, settings)
            report({"event": "waiting", "link": link.uri})
            if isinstance(pacing, Tolerant):
                meet_autopilot(options.wait_s, endpoint, stop, emulator.on_request)
            else:
                meet_controller(scenario, options.wait_s, endpoint, stop, emulator.on_request)
            report({"event": "started", "peer": link.peer})
            if options.legs and isinstance(pacing, RealTime):
                pacing.legs = LegTable(TICK_COLUMNS), LegTable(ANSWER_COLUMNS)
            return _run_ticks(scenario, emulator, pacing, options.out, report, settings)
    finally:
        _close_files(log, truth)


def _open_files(
    scenario: Scenario, link: Link, options: EmulatorOptions, out: Path, report: Report
) -> tuple[TlogWriter | None, TruthWriter | None]:
    """Begin the log and the ground truth of a run; None each where the disk refuses and the user chose to go on."""
    tell = _teller(options, report)
    source = {
        "scenario": scenario.name,
        "law": scenario.law,
        "seed": scenario.seed,
        "rate_hz": scenario.rate_hz,
        "duration_s": scenario.duration_s,
        "digest": scenario.digest().hex(),
        "clock": options.clock,
    }
    recorded = LinkOfLog(link.uri, sent_by=((VEHICLE[0], scenario.wire.emulator_component),))
    lockstep = options.clock == "lockstep"
    stamps = "simulation time" if lockstep else "Unix time"
    log = truth = None
    try:
        make_folder(out)
        write_text(out / "scenario.toml", scenario.to_toml())
        truth = TruthWriter(out / "ground_truth.npy", tell=tell)
        log = RingRecorder(out / "run.tlog", recorded, stamps=stamps, source=source, may_wait=lockstep, tell=tell)
    except RunFolderError as error:
        if tell is None:
            _close_files(log, truth)
            raise
        tell(str(error))
    return log, truth


def _teller(options: EmulatorOptions, report: Report) -> Callable[[str], None] | None:
    """Who hears of a disk that refuses, where the user chose to go on; None: it ends the run."""
    if options.on_log_error != "continue":
        return None
    return lambda sentence: report({"event": "warning", "text": f"{sentence}; the run goes on"})


def warm_up(scenario: Scenario) -> None:
    """Have every kernel of a run compiled (or loaded) before a controller waits for an answer."""
    near, far = memory_pair()
    with near, far:
        emulator = Emulator(scenario, Endpoint(near, *VEHICLE), None)
        emulator.sense(0)
        command = ActuatorCommand(0, np.zeros(6), armed=True)
        emulator.decode(mavlink_map.encode_command(command, np.ones(6), lockstep=True))
        emulator.act(0, 0, command)
        emulator.advance(scenario.period_ns)
        emulator.go_on(b"", 0, 1, 0)


def _motors(
    scenario: Scenario, options: EmulatorOptions, report: Report, stop: StopFlag
) -> contextlib.AbstractContextManager[CanMotors | None]:
    """The drives behind a bus, where there is one: python-can is loaded only then."""
    if options.motors is None:
        return contextlib.nullcontext()
    from plant_emulator.motor_setup import open_motors

    return open_motors(
        scenario,
        options.motors,
        options.out,
        clock=options.clock,
        wait_s=options.wait_s,
        report=report,
        stop=stop,
        tell=_teller(options, report),
    )


def _pacing(scenario: Scenario, options: EmulatorOptions, parts: Parts, settings: Settings) -> Pacing:
    if options.clock == "realtime":
        spin_ns = choose_spin_ns(parts.clock, scenario.period_ns, options.spin_s, measure=has_own_core(settings))
        through = not options.motors and parts.endpoint.link.stamp_receives()  # drives on a bus are told at once
        return RealTime(
            parts, ticks=scenario.ticks, spin_ns=spin_ns, sleeps_through=through, added_delay_ns=options.delay_ns
        )
    keeper = RateKeeper(parts.clock, round(scenario.period_ns / options.speed)) if options.speed else None
    if options.profile == "tolerant":
        return Tolerant(parts, ticks=scenario.ticks, delay_ns=scenario.delay_ns, keeper=keeper, wait_s=options.wait_s)
    return Lockstep(parts, ticks=scenario.ticks, delay_ns=scenario.delay_ns, keeper=keeper)


def meet_controller(
    scenario: Scenario, wait_s: float, endpoint: Endpoint, stop: StopFlag, on_request: OnRequest | None = None
) -> None:
    """Hold the plant at t = 0 until a controller with the same scenario says it is armed. Raises PeerError, Interrupted."""
    digest = scenario.digest()
    agreed = heard = False
    clock = MonotonicClock()
    give_up_ns = clock.now_ns() + round(wait_s * NANOSECONDS)
    due = Due(1.0 / HELLO_PERIOD_S)
    while (now_ns := clock.now_ns()) < give_up_ns:
        stop.check()
        hello = [
            endpoint.seal(mavlink_map.HEARTBEAT, mavlink_map.encode_emulator_heartbeat()),
            endpoint.seal(mavlink_map.VERSION, mavlink_map.encode_version(digest)),
        ]
        if heard and due.at(now_ns):
            endpoint.send(hello)
        received = endpoint.receive(HELLO_PERIOD_S)
        if on_request:
            for frame in received:
                on_request.take(frame)
            if replies := on_request.replies():
                endpoint.send(endpoint.seal(*reply) for reply in replies)
        for frame in received:
            if (frame.system, frame.component) != VEHICLE:
                continue
            if not heard:
                endpoint.send(hello)
            heard = True
            if frame.message_id == mavlink_map.VERSION.message_id:
                refuse_other_scenario("controller", mavlink_map.decode_version(frame.payload), digest)
                agreed = True
            elif (
                frame.message_id == mavlink_map.HEARTBEAT.message_id
                and agreed
                and mavlink_map.heartbeat_is_armed(frame.payload)
            ):
                endpoint.writer.sequence = 0  # the numbers of the run, and so its log, begin with the first tick
                return
    uri = endpoint.link.uri
    if heard:
        raise PeerMissingError(
            f"the controller at {endpoint.link.peer} did not arm within {wait_s:g} s: start it with --arm"
        )
    raise PeerMissingError(
        f"no controller came to {uri} within {wait_s:g} s: start one with `fwav-hil controller "
        f"SCENARIO --link {uri.replace('in://', 'out://', 1)}`, or wait longer with --wait"
    )


def _heartbeat() -> bytes:
    return mavlink_map.encode_emulator_heartbeat()


def _run_ticks(
    scenario: Scenario, emulator: Emulator, pacing: Pacing, out: Path | None, report: Report, settings: Settings
) -> dict[str, Any]:
    period_ns, clock = scenario.period_ns, pacing.clock
    begun_ns, processor_ns = clock.now_ns(), processor_time_ns()
    next_progress_ns = last_ns = begun_ns
    ticks_ns: list[int] = []
    done = 0
    error: FwavHilError | None = None
    try:
        for tick in range(scenario.ticks):
            t_ns = tick * period_ns
            pacing.exchange(tick, t_ns)
            done = tick + 1
            now_ns = clock.now_ns()
            ticks_ns.append(now_ns - last_ns)
            last_ns = now_ns
            if now_ns >= next_progress_ns:
                next_progress_ns = now_ns + PROGRESS_PERIOD_NS
                pacing.flush()
                emulator.flush()
                report({"event": "progress", "t_ns": t_ns + period_ns, "q": emulator.plant.state.motion[:6].tolist()})
    except FwavHilError as stopped:
        error = stopped
    wall_ns = clock.now_ns() - begun_ns
    processor_ns = processor_time_ns() - processor_ns
    _say_farewell(emulator, pacing, done * period_ns)
    counters = {**emulator.all_counters(), **pacing.all_counters()}
    summary = {
        "clock": "realtime" if isinstance(pacing, RealTime) else "lockstep",
        "ticks": done,
        "wall_s": wall_ns / NANOSECONDS,
        "latency_us": percentiles_us(pacing.latencies_ns),
        "tick_us": percentiles_us(ticks_ns),
        "lateness_us": pacing.keeper.summary() if pacing.keeper else None,
        "realtime": settings,
        "processor_share": processor_ns / max(1, wall_ns),
        "counters": counters,
        "error": str(error) if error else None,
    }
    if isinstance(pacing.log, RingRecorder):
        pacing.log.sidecar["counters"] = counters
        pacing.log.sidecar["links"][0]["peer"] = pacing.endpoint.link.peer
    if emulator.motors:
        summary["can"] = emulator.motors.summary(done * period_ns / NANOSECONDS)
    if out:
        write_json(out / "emulator.json", summary)
        if isinstance(pacing, RealTime) and pacing.legs:
            ticks, answers = pacing.legs
            clocks = LegTable(CLOCK_COLUMNS)
            for answer in pacing.time_sync.answers:
                clocks.add(*answer)
            tables = {"ticks": ticks, "answers": answers, "clocks": clocks}
            save_legs(out / EMULATOR_FILE, tables, pacing.time_sync.estimate)
    report({"event": "ended", **summary})
    if error:
        raise error
    return summary


def _say_farewell(emulator: Emulator, pacing: Pacing, t_ns: int) -> None:
    """Tell the controller that the run is over, and log it once."""
    payload = mavlink_map.encode_emulator_heartbeat(ending=True)
    frames = [pacing.endpoint.seal(mavlink_map.HEARTBEAT, payload) for _ in range(FAREWELLS)]
    try:
        for frame in frames:
            pacing.endpoint.send([frame])
    except FwavHilError:
        pass  # the link may be what ended the run
    if isinstance(pacing, Lockstep):
        pacing.owe_log(t_ns // 1000, frames[:1])
    pacing.settle_log()


def _close_files(log: TlogWriter | None, truth: TruthWriter | None) -> None:
    """Close both files, the second one even where the first cannot be written."""
    problem: RunFolderError | None = None
    for file in (log, truth):
        try:
            if file:
                file.close()
        except RunFolderError as error:
            problem = error
    if problem:
        raise problem
