"""Recording live links into a log. It listens, and never says a word on them."""

from __future__ import annotations

import sys
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from bridge.links.link import NOBODY, Link
from bridge.process import StopFlag, open_patiently
from bridge.recording.recorder import Tell
from bridge.recording.sidecar import LinkOfLog
from bridge.recording.thread_recorder import Recorder, refuse_existing_log
from bridge.timing.clock import MonotonicClock, unix_time_us
from fwav_hil.progress import StatusLine
from protocol.logs.keeping import FrameKeeper

LOOK_PERIOD_S = 0.1
_RATE_PERIOD_S = 0.5


class Listener:
    """One link, heard in a thread of its own; every frame goes to the recorder under the time at which it arrived.

    frames, kinds, peers   how many came, how many of each message, and who was heard
    """

    def __init__(self, number: int, link: Link, recorder: Recorder) -> None:
        self.number = number
        self.link = link
        self.ending = False
        self.frames = 0
        self.kinds: Counter[str] = Counter()
        self.peers: set[str] = set()
        self._recorder = recorder
        self._reader = FrameKeeper(is_datagram=link.is_datagram)

    def run(self) -> None:
        """Listen until told to end. Raises LinkError, and RunFolderError where the recorder does."""
        while not self.ending:
            data = self.link.recv(LOOK_PERIOD_S)
            t_us = unix_time_us()
            if data is None:
                self._recorder.flush()  # tells, where the disk refuses
                continue
            self.peers.add(self.link.peer)
            if self.link.is_datagram:
                self.link.release_peer()  # whoever else sends here is recorded too, an empty datagram or not
            for frame in self._reader.read(data):
                self._recorder.write(t_us, frame.raw, self.number)
                self.kinds[frame.name] += 1
                self.frames += 1

    def counters(self) -> dict[str, int]:
        """What the link and the reader have counted, by name."""
        dropped = {"dropped_by_system": self.link.dropped_by_system()}
        return {**self.link.stats.as_dict(), **self._reader.counters, **dropped}


def record(
    uris: tuple[str, ...],
    log: Path,
    stop: StopFlag,
    *,
    duration_s: float | None = None,
    wait_s: float = 30.0,
    goes_on: bool = False,
) -> dict[str, Any]:
    """Record until the duration is over, the user stops it or a link ends; returns what came.

    goes_on: a disk that refuses is told of and does not end the recording. Raises LinkError, PeerMissingError, RunFolderError
    and, while it still waits for its links, Interrupted; what came until then is in the log.
    """
    refuse_existing_log(log)
    with ExitStack() as stack:
        links = [stack.enter_context(open_patiently(uri, wait_s, stop)) for uri in uris]
        source = {"scenario": None, "seed": None, "clock": None}
        ends = tuple(LinkOfLog(link.uri) for link in links)
        tell: Tell | None = _say_and_go_on if goes_on else None
        recorder = stack.enter_context(Recorder(log, ends, stamps="Unix time", source=source, tell=tell))
        _say(f"recording {', '.join(link.uri for link in links)} into {log}; Ctrl-C ends it")
        listeners = [Listener(number, link, recorder) for number, link in enumerate(links)]
        try:
            wall_s = _listen(listeners, stop, duration_s)
        finally:
            dropped = 0
            for listener in listeners:
                counters = listener.counters()
                dropped += counters["dropped_by_system"]
                recorder.sidecar["counters"][str(listener.number)] = counters
                recorder.sidecar["links"][listener.number]["peer"] = ", ".join(sorted(listener.peers - {NOBODY}))
            if dropped:
                recorder.lost += dropped
                recorder.sidecar["error"] = (
                    f"the system dropped {dropped} datagrams, which came faster than they were read"
                )
    return {
        "log": str(log),
        "links": recorder.sidecar["links"],
        "duration_s": wall_s,
        "frames": recorder.sidecar["frames"],
        "frames_per_s": recorder.sidecar["frames"] / wall_s,
        "bytes": recorder.sidecar["bytes"],
        "lost": recorder.lost,
        "error": recorder.sidecar["error"],
        "messages": dict(sum((listener.kinds for listener in listeners), Counter[str]()).most_common()),
        "counters": recorder.sidecar["counters"],
    }


def _listen(listeners: list[Listener], stop: StopFlag, duration_s: float | None) -> float:
    """Have every link heard until the end, and show how it goes; returns how long that was (s)."""
    clock, line = MonotonicClock(), StatusLine()
    begun_ns = shown_ns = clock.now_ns()
    end_ns = begun_ns + round(duration_s * 1e9) if duration_s else None
    shown = 0
    with ThreadPoolExecutor(len(listeners)) as threads:
        tasks: list[Future[None]] = [threads.submit(listener.run) for listener in listeners]
        try:
            while not stop.requested and not any(task.done() for task in tasks):
                now_ns = clock.now_ns()
                if end_ns and now_ns >= end_ns:
                    break
                if now_ns - shown_ns > 1e9 * _RATE_PERIOD_S:
                    count = sum(listener.frames for listener in listeners)
                    rate = (count - shown) / ((now_ns - shown_ns) * 1e-9)
                    line.show(f"{(now_ns - begun_ns) * 1e-9:.1f} s, {count} frames, {rate:.0f} frames/s")
                    shown_ns, shown = now_ns, count
                next_ns = now_ns + round(1e9 * LOOK_PERIOD_S)
                clock.sleep_until_ns(min(next_ns, end_ns) if end_ns else next_ns)
        finally:
            for listener in listeners:
                listener.ending = True
            line.end()
    for task in tasks:
        task.result()
    return (clock.now_ns() - begun_ns) * 1e-9


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def _say_and_go_on(sentence: str) -> None:
    _say(f"{sentence}; the recording goes on")
