"""Open-loop probes of a link: requests on an absolute schedule, each response timed from when its request was due.

A sender that waits for late responses sends less often just when the link is slow, and its figures hide that (coordinated
omission). These probes never wait: the schedule is absolute, and a request that left late is timed from when it was due.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bridge.links.link import Link
from bridge.process import StopFlag
from bridge.timing.clock import Clock

Matcher = Callable[[bytes], list[int]]
"""Gives the numbers of the probes that a received datagram or chunk answers."""


class ProbeResult(NamedTuple):
    """Result of the probes; both times of an unanswered one are -1.

    from_due_ns (n,)   arrival of the response minus the time its request was due (free of coordinated omission)
    from_sent_ns (n,)  arrival of the response minus the time its request was sent
    duplicates, out_of_order, unknown   responses that were repeated, came after a later one's, or match no request
    """

    from_due_ns: npt.NDArray[np.int64]
    from_sent_ns: npt.NDArray[np.int64]
    duplicates: int
    out_of_order: int
    unknown: int

    @property
    def lost(self) -> int:
        """Requests without a response."""
        return int((self.from_due_ns < 0).sum())


def probe(
    link: Link,
    clock: Clock,
    stop: StopFlag,
    *,
    period_ns: int,
    count: int,
    question: Callable[[int], bytes],
    answered: Matcher,
    linger_ns: int = 500_000_000,
    progress: Callable[[int], None] = lambda _sent: None,
) -> ProbeResult:
    """Send question(k) for k = 0 .. count - 1, one per period, and time the responses; wait `linger_ns` for the last ones.

    Raises what the link raises, and Interrupted.
    """
    due = np.zeros(count, dtype=np.int64)
    sent = np.zeros(count, dtype=np.int64)
    came = np.full(count, -1, dtype=np.int64)
    newest, counts = -1, {"duplicates": 0, "out_of_order": 0, "unknown": 0}
    begun_ns = clock.now_ns() + period_ns
    asked = 0
    end_ns = begun_ns
    # Every request is sent, however late: one that was not sent would count as lost.
    while asked < count or (clock.now_ns() < end_ns and (came < 0).any()):
        now_ns = clock.now_ns()
        stop.check()
        if asked < count and now_ns >= begun_ns + asked * period_ns:
            due[asked] = begun_ns + asked * period_ns
            datagram = question(asked)
            sent[asked] = clock.now_ns()
            link.send(datagram)
            end_ns = clock.now_ns() + linger_ns
            asked += 1
            if asked % 64 == 0:
                progress(asked)
            continue
        until_ns = begun_ns + asked * period_ns if asked < count else end_ns
        data = link.recv(min(0.1, max(0, until_ns - now_ns) * 1e-9))
        if not data:
            continue
        arrived_ns = link.received_ns or clock.now_ns()
        for number in answered(data):
            if not 0 <= number < asked:
                counts["unknown"] += 1
            elif came[number] >= 0:
                counts["duplicates"] += 1
            else:
                came[number] = arrived_ns
                counts["out_of_order"] += number < newest
                newest = max(newest, number)
    known = came >= 0
    # Kernel stamps use the wall clock: if that was set back meanwhile, the response must not count as lost.
    from_due_ns, from_sent_ns = (np.where(known, np.maximum(came - since, 0), -1) for since in (due, sent))
    return ProbeResult(from_due_ns, from_sent_ns, **counts)
