"""Answers TIMESYNC on a link, as an autopilot does: the far end of the probes of `fwav-hil latency`.

`python -m bridge.latency.responder URI` prints the URI it listens on, then answers until its parent ends or SIGTERM comes.
"""

from __future__ import annotations

import sys

from bridge.endpoint import Endpoint
from bridge.links.link import open_link
from bridge.process import StopFlag, end_with_parent
from bridge.timing.clock import MonotonicClock
from bridge.timing.timesync import TimeSync
from protocol.errors import FwavHilError
from protocol.messages import VEHICLE
from protocol.wire import mapping

_LOOK_S = 0.1


def respond(endpoint: Endpoint, stop: StopFlag) -> None:
    """Answer every TIMESYNC request until a stop is requested."""
    clock = MonotonicClock()
    time_sync = TimeSync(endpoint.seal, clock)
    while not stop.requested:
        for frame in endpoint.receive(_LOOK_S):
            if frame.message_id == mapping.TIMESYNC.message_id:
                answer = time_sync.handle(frame, clock.now_ns())
                if answer:
                    endpoint.send([answer])


def main(uri: str) -> int:
    """Open the link and answer; returns the exit code."""
    end_with_parent()
    stop = StopFlag()
    stop.install()
    try:
        with open_link(uri) as link:
            endpoint = Endpoint(link, *VEHICLE)
            sys.stdout.write(link.uri + "\n")
            sys.stdout.flush()
            respond(endpoint, stop)
    except FwavHilError as error:
        sys.stderr.write(f"responder: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
