"""A simple mavutil script with the same messages: a reference that `fwav-hil latency --against` measures.

`python -m protocol.wire.mavutil_peer` prints its port, then answers each HIL_SENSOR with HIL_ACTUATOR_CONTROLS until its
parent ends.
"""

from __future__ import annotations

import os
import sys

from pymavlink import mavutil

from protocol.wire.mapping import ARMED, HIL, LOCKSTEP_FLAG


def main() -> None:
    """Answer until ended."""
    parent = os.getppid()
    connection = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=1, source_component=1, dialect="common")
    sys.stdout.write(f"{connection.port.getsockname()[1]}\n")
    sys.stdout.flush()
    controls = [0.0] * 16
    while os.getppid() == parent:
        tick = connection.recv_match(type="HIL_SENSOR", blocking=True, timeout=1.0)
        if tick:
            connection.mav.hil_actuator_controls_send(tick.time_usec, controls, ARMED | HIL, LOCKSTEP_FLAG)


if __name__ == "__main__":
    main()
