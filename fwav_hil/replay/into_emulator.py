"""Replay the recorded commands into the plant and compare its motion with the recorded one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bridge.endpoint import Endpoint
from bridge.links.link import Link, counterpart
from bridge.links.memory import memory_pair
from bridge.process import StopFlag, open_patiently
from fwav_hil.children import Child, listen
from fwav_hil.jobs import Job
from fwav_hil.replay.other_end import other_end
from fwav_hil.replay.recorded_run import Recorded, Tick
from fwav_hil.replay.replay_result import Difference
from plant_emulator.command_source import Found
from plant_emulator.options import EmulatorOptions
from plant_emulator.tick import Emulator
from protocol.errors import PeerLostError, PeerMissingError
from protocol.messages import VEHICLE, FloatArray
from protocol.scenario import with_overrides
from protocol.wire import mapping
from protocol.wire.codec import FrameReader

_SILENCE_S = 3.0
_HELLO_PERIOD_S = 0.1


def replay_in_process(run: Recorded) -> Difference:
    """Fly the scenario's plant with the recorded commands, in this process. Raises DivergenceError.

    With a lockstep log each command acts exactly as recorded. In real time it acted on arrival, which the log has to a
    microsecond only: the motion is then close to the recorded one, not identical.
    """
    near, far = memory_pair()
    with near, far:
        endpoint = Endpoint(near, VEHICLE[0], run.scenario.wire.emulator_component)
        emulator = Emulator(run.scenario, endpoint, None)
        source, period_ns = emulator.source, run.scenario.period_ns
        sent: dict[int, bytes] = {}
        for number, tick in enumerate(run.ticks):
            t_ns = number * period_ns
            sent[t_ns] = emulator.sense(t_ns)
            source.expect(0, t_ns)
            for stamp_us, frame in tick.answers:
                source.feed(frame.raw)
                if source.read() != Found.COMMAND:
                    continue
                if run.lockstep:
                    emulator.act(t_ns, run.scenario.delay_ns)
                else:
                    since_tick_ns = min(max(0, 1000 * (stamp_us - tick.stamp_us)), period_ns)
                    emulator.act(t_ns + since_tick_ns, 0)
                emulator.settle()
            others, source.others = source.others, []
            emulator.hear(others)
            if not run.lockstep:
                emulator.check_staleness(t_ns + period_ns)
            emulator.advance(t_ns + period_ns)
    return compare_motion(run, sent)


def replay_into_process(run: Recorded, wait_s: float, stop: StopFlag) -> Difference:
    """Start an emulator process and answer each of its ticks with the recorded answer.

    Raises LinkError, PeerError and Interrupted.
    """
    scenario = with_overrides(run.scenario, duration_s=len(run.ticks) * run.scenario.period_ns * 1e-9)
    options = EmulatorOptions(link="udpin://127.0.0.1:0", wait_s=wait_s)
    with (
        other_end("plant_emulator", Job(scenario, options), stop) as (child, watch),
        open_patiently(counterpart(_link_of(child)), wait_s, watch) as link,
    ):
        return compare_motion(run, answer_emulator(run, link, wait_s, watch))


def _link_of(child: Child) -> str:
    for _, event in listen([child]):
        if event.get("event") == "waiting":
            return str(event["link"])
    child.end()
    raise PeerMissingError(child.failure or "the emulator ended before it opened its link")


def answer_emulator(run: Recorded, link: Link, wait_s: float, stop: StopFlag) -> dict[int, bytes]:
    """Act as the recorded controller; returns the datagram of each tick by its time (ns).

    Raises PeerError, LinkError and Interrupted.
    """
    endpoint = Endpoint(link, *VEHICLE)
    reader = FrameReader(is_datagram=True)
    answers = {tick.t_ns: tick.answer for tick in run.ticks}
    hello = [
        (mapping.HEARTBEAT, mapping.encode_controller_heartbeat(armed=True)),
        (mapping.VERSION, mapping.encode_version(run.scenario.digest())),
    ]
    sent: dict[int, bytes] = {}
    waits = 0
    while True:
        stop.check()
        if not sent:
            endpoint.send([endpoint.seal(*said) for said in hello])
        data = link.recv(_HELLO_PERIOD_S)
        waits = 0 if data else waits + 1
        if waits * _HELLO_PERIOD_S > (_SILENCE_S if sent else wait_s):
            raise PeerLostError("the emulator fell silent during the replay: check that the scenario is the log's")
        for frame in reader.read(data or b""):
            if frame.message_id == mapping.HEARTBEAT.message_id and mapping.heartbeat_is_ending(frame.payload):
                return sent
            if frame.message_id == mapping.TICK.message_id and data:
                t_ns = mapping.decode_tick_time_ns(frame.payload)
                sent[t_ns] = data
                if not answers.get(t_ns):
                    raise PeerLostError(f"the log holds no command for t = {t_ns * 1e-9:.3f} s: replay it with --fast")
                link.send(answers[t_ns])


def compare_motion(run: Recorded, sent: Mapping[int, bytes]) -> Difference:
    """The recorded ticks and those of a replay: every byte that the emulator sent is compared; the pose is shown."""
    recorded = {tick.t_ns: tick for tick in run.ticks}
    both = sorted(recorded.keys() & sent.keys())
    reader = FrameReader(is_datagram=True, follow_sequence=False)

    def pose(payload: bytes) -> FloatArray:
        sample = mapping.decode_pose(payload)
        return sample.q if sample else np.full(6, np.nan)

    def pose_in(datagram: bytes) -> bytes:
        return next((f.payload for f in reader.read(datagram) if f.message_id == mapping.POSE.message_id), b"")

    def equal(tick: Tick) -> bool:
        return tick.datagram == sent[tick.t_ns]

    return Difference(
        "motion",
        np.array(both, dtype=np.int64),
        np.array([pose(recorded[t].pose) for t in both]).reshape(-1, 6),
        np.array([pose(pose_in(sent[t])) for t in both]).reshape(-1, 6),
        np.array([equal(recorded[t]) for t in both], dtype=np.bool_),
        len(recorded.keys() ^ sent.keys()),
    )
