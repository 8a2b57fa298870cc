"""A ground station's link: read without waiting, with heartbeats by wall time, and recorded.

The station may connect and disconnect at any time: nothing it does ends a run. The link has its own sequence numbers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from bridge.links.link import Link
from bridge.process import StopFlag, open_patiently
from bridge.summary import make_folder
from bridge.timing.clock import Clock, MonotonicClock
from protocol.due import Due
from protocol.errors import LinkError
from protocol.logs.tlog import TlogWriter
from protocol.wire import mapping
from protocol.wire.codec import Frame, FrameReader, FrameWriter, Layout
from protocol.wire.streams import stream

POLL_HZ = 50.0
"""How often an end of the loop polls its station's link, in simulation time."""
_MOST_AT_ONCE = 64


@contextlib.contextmanager
def open_station(
    uri: str | None,
    who: tuple[int, int],
    heartbeat: Callable[[], bytes],
    record: Path | None,
    wait_s: float,
    stop: StopFlag,
) -> Iterator[Station | None]:
    """The station on a link, its messages recorded in the file `record`; None where no link is given.

    Raises what `open_patiently` raises, and RunFolderError.
    """
    if uri is None:
        yield None
        return
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(open_patiently(uri, wait_s, stop))
        log = None
        if record:
            make_folder(record.parent)
            log = TlogWriter(record)
            stack.callback(log.close)
        yield Station(link, who, MonotonicClock(), heartbeat, log)


class Station:
    """One end of a station's link, as the component `who`.

    heartbeat: gives the payload of this component's HEARTBEAT. log: records all frames both ways, or None.
    """

    def __init__(
        self,
        link: Link,
        who: tuple[int, int],
        clock: Clock,
        heartbeat: Callable[[], bytes],
        log: TlogWriter | None = None,
    ) -> None:
        self._link = link
        self._clock = clock
        self._heartbeat = heartbeat
        self._due = Due(stream("HEARTBEAT").rate_hz or 1.0)
        self._reader = FrameReader(is_datagram=link.is_datagram, follow_sequence=False)
        self._writer = FrameWriter(*who)
        self._log = log
        self.departures = 0
        """How often a station has disconnected, or was released."""
        self.t_us = 0
        """The time with which frames are logged."""

    def poll(self) -> list[Frame]:
        """The frames received since the last poll; a heartbeat is sent if one is due."""
        frames: list[Frame] = []
        try:
            if self._due.at(self._clock.now_ns()):
                self.say(mapping.HEARTBEAT, self._heartbeat())
            for _ in range(_MOST_AT_ONCE):
                data = self._link.recv(0.0)
                if not data:
                    break
                frames += self._reader.read(data)
        except LinkError:
            self.release()
        if self._log:
            for frame in frames:
                self._log.write(self.t_us, frame.raw)
        return frames

    def say(self, message: Layout, payload: bytes) -> None:
        """Send a frame; it is lost where no station is connected."""
        frame = self._writer.seal(message, payload)
        try:
            self._link.send(frame)
        except LinkError:
            self.release()
        if self._log:
            self._log.write(self.t_us, frame)

    def release(self) -> None:
        """Release the station, so that another one can connect."""
        self.departures += 1
        self._link.release_peer()

    def counters(self) -> dict[str, int]:
        """Counters of the link and its reader, each name beginning with station_."""
        counted = {**self._link.stats.as_dict(), **self._reader.counters}
        return {f"station_{name}": count for name, count in counted.items()}
