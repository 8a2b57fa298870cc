"""The controller's part of a tick, always in this order: receive, handle other frames, answer, send, record.

The live process, the replay of a log into the controller, and the tests call this; the in-process simulation calls
the same kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from controller.laws.law import Law
from controller.laws.reference import evaluate_reference
from controller.sinks.sink import CommandSink
from controller.sources.source import Found, PoseSource
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameWriter
from protocol.wire.schedule import Encoder, Saying

_SAMPLE, _AGAIN = Found.SAMPLE, Found.AGAIN


class Session(Protocol):
    """What a tick needs to know of the session with the peer."""

    armed: bool

    def hear(self, frame: Frame) -> None:
        """React to a frame that carries no pose."""

    def due_frames(self, t_ns: int) -> list[bytes]:
        """Frames sent with the answer to the sample of t_ns, before the command."""


class Tick:
    """Answers the samples of a source with a law, through a sink.

    send       called with the complete answer to a sample
    at_once    answer each sample as it is read; else the newest is kept (`is_fresh`) until `answer` is called

    answered_ns   time of the sample answered last; -1 before the first
    counters      repeated         answers sent again, because their tick arrived again or the next one is missing
                  skipped_samples  samples not answered because a newer one had arrived
    """

    def __init__(
        self,
        law: Law,
        source: PoseSource,
        sink: CommandSink,
        session: Session,
        writer: FrameWriter,
        send: Callable[[bytes], None],
        *,
        at_once: bool = True,
    ) -> None:
        self.law, self.state = law, law.start()
        self.source, self.sink, self.session = source, sink, session
        self.answered_ns = -1
        self.is_fresh = False
        self.at_once = at_once
        self._writer = writer
        self._send = send
        self._last = b""
        self._was_armed = False
        self.counters = {"repeated": 0, "skipped_samples": 0}

    def process(self, data: bytes) -> None:
        """Process the received bytes in the order on the wire. Raises what the session raises for a frame."""
        source = self.source
        source.feed(data)
        while True:
            found = source.read()
            if source.others:
                others, source.others = source.others, []
                for frame in others:
                    self.session.hear(frame)
            if found is _SAMPLE:
                self.counters["skipped_samples"] += self.is_fresh
                self.is_fresh = True
                if self.at_once:
                    self.answer()
            elif found is _AGAIN and self.at_once:
                self.repeat()
            if source.is_read:
                return

    def answer(self) -> None:
        """Step the law on the newest sample and send its command; after being disarmed the law starts anew."""
        t_ns, armed = self.source.t_ns, self.session.armed
        if not (armed and self._was_armed):
            self.law.restart(self.state)  # the commands in a disarmed law's state never acted
        self._was_armed = armed
        if self.answered_ns < 0:
            self._writer.sequence = 0  # the run's sequence numbers begin with its first answer
        due = self.session.due_frames(t_ns)
        command = self.sink.answer(self.law, self.state, t_ns, self.source.q, armed=armed)
        self.is_fresh = False
        self.answered_ns = t_ns
        self._last = b"".join((*due, command)) if due else command
        self._send(self._last)

    def repeat(self) -> None:
        """Send the last answer again, the same bytes, without stepping the law."""
        if self._last:
            self.counters["repeated"] += 1
            self._send(self._last)


def reference_encoders(law: Law) -> dict[str, Encoder]:
    """The reference at the time of a sample, for the log: POSITION_TARGET_LOCAL_NED and ATTITUDE_TARGET."""
    desired = np.empty((3, 6))

    def position(t_ns: int) -> list[Saying]:
        evaluate_reference(t_ns * 1e-9, law.reference, *desired)
        return [(mapping.POSITION_TARGET, mapping.encode_position_target(t_ns, *desired))]

    def attitude(t_ns: int) -> list[Saying]:
        evaluate_reference(t_ns * 1e-9, law.reference, *desired)
        return [(mapping.ATTITUDE_TARGET, mapping.encode_attitude_target(t_ns, desired[0]))]

    return {"POSITION_TARGET_LOCAL_NED": position, "ATTITUDE_TARGET": attitude}
