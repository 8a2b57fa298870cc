"""Replay the recorded samples into a controller and compare its commands with the recorded ones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bridge.endpoint import Endpoint
from bridge.links.link import Link, counterpart, open_link
from bridge.process import StopFlag
from controller.laws.law import make_law
from controller.laws.registry import refuse_on_a_link
from controller.options import ControllerOptions
from controller.parameters import followed
from controller.sinks.hil import HilSink
from controller.sources.hil import HilSource
from controller.tick import Tick
from fwav_hil.jobs import Job
from fwav_hil.replay import recorded_run
from fwav_hil.replay.other_end import other_end
from fwav_hil.replay.recorded_run import Recorded
from fwav_hil.replay.replay_result import Difference
from plant_emulator.pacing.lockstep import RESEND_AFTER_S
from plant_emulator.pacing.meeting import meet_controller
from plant_emulator.process import FAREWELLS
from protocol.errors import PeerLostError
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter, lone_frame
from protocol.wire.mapping import is_armed

_LINK = "udpin://127.0.0.1:0"


class _RecordedSession:
    """Armed as the recorded controller was; sends only commands."""

    armed = False

    def hear(self, frame: Frame) -> None:
        """Ignore frames without a pose."""

    def due_frames(self, _t_ns: int) -> list[bytes]:
        """No other frames."""
        return []


def replay_in_process(run: Recorded) -> Difference:
    """Let the controller's `Tick` answer the samples, in this process. Raises UsageError for state feedback."""
    refuse_on_a_link(run.scenario)
    law = make_law(run.scenario.law, run.scenario)
    session, answers = _RecordedSession(), dict[int, bytes]()
    writer = FrameWriter(*VEHICLE)
    source = HilSource(FrameReader(is_datagram=True), (VEHICLE[0], run.scenario.wire.emulator_component))

    def keep(answer: bytes) -> None:
        answers.setdefault(controller.answered_ns, lone_frame(answer).payload)

    controller = Tick(law, source, HilSink(writer, lockstep=run.lockstep), session, writer, keep)
    scenario = run.scenario
    for tick in run.ticks:
        if (gains := followed(scenario, tick.parameters)) is not scenario:
            scenario = gains  # set while disarmed: the law restarts with them
            law.adopt(make_law(law.name, gains))
        recorded = run.commands.get(tick.t_ns)
        session.armed = recorded is None or is_armed(recorded)
        controller.process(tick.datagram)
    return compare_commands(run, answers)


def replay_into_process(run: Recorded, wait_s: float, stop: StopFlag) -> Difference:
    """Start a controller process and send it the samples over a link, one for each answer.

    Raises UsageError for state feedback, LinkError, PeerError and Interrupted.
    """
    refuse_on_a_link(run.scenario)
    with open_link(_LINK) as link:
        options = ControllerOptions(
            link=counterpart(link.uri), clock="lockstep" if run.lockstep else "realtime", wait_s=wait_s
        )
        with other_end("controller", Job(run.scenario, options), stop) as (_, watch):
            return compare_commands(run, ask_controller(run, link, wait_s, watch))


def ask_controller(run: Recorded, link: Link, wait_s: float, stop: StopFlag) -> dict[int, bytes]:
    """Act as the recorded emulator; returns the payload of each command by the time of its sample (ns).

    Raises PeerError, LinkError and Interrupted.
    """
    endpoint = Endpoint(link, VEHICLE[0], run.scenario.wire.emulator_component)
    meet_controller(run.scenario, wait_s, endpoint, stop)
    answers: dict[int, bytes] = {}
    for tick in run.ticks:
        stop.check()
        if tick.t_ns not in answers:
            answers[tick.t_ns] = _answer(endpoint, tick)
    farewell = mapping.encode_emulator_heartbeat(ending=True)
    for _ in range(FAREWELLS):
        endpoint.send([endpoint.seal(mapping.HEARTBEAT, farewell)])
    return answers


def _answer(endpoint: Endpoint, tick: recorded_run.Tick) -> bytes:
    for wait_s in RESEND_AFTER_S:
        endpoint.link.send(tick.datagram)
        while frames := endpoint.receive(wait_s):
            for frame in frames:
                payload = frame.payload.ljust(mapping.COMMAND.size, b"\0")
                if (
                    frame.message_id == mapping.COMMAND.message_id
                    and int.from_bytes(payload[:8], "little") * 1000 == tick.t_ns
                ):
                    return payload
    raise PeerLostError(
        f"the controller did not answer the recorded sample at t = {tick.t_ns * 1e-9:.3f} s within 2 s: "
        "check that the scenario is the log's"
    )


def compare_commands(run: Recorded, answers: Mapping[int, bytes]) -> Difference:
    """The recorded commands and those of a replay, by sample time: every byte of the payload is compared."""
    both = sorted(run.commands.keys() & answers.keys())
    scale = np.array(run.scenario.actuators.scale)
    size = mapping.COMMAND.size

    def tau(payloads: list[bytes]) -> np.typing.NDArray[np.float64]:
        table = np.frombuffer(b"".join(payloads), dtype=mapping.COMMAND.dtype)
        return table["controls"][:, :6].astype(float) * scale if len(table) else np.empty((0, 6))

    recorded, replayed = [run.commands[t] for t in both], [answers[t].ljust(size, b"\0") for t in both]
    return Difference(
        "command",
        np.array(both, dtype=np.int64),
        tau(recorded),
        tau(replayed),
        np.array([a == b for a, b in zip(recorded, replayed, strict=True)], dtype=np.bool_),
        len(run.commands.keys() ^ answers.keys()),
    )
