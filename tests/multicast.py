"""Whether this machine can carry CAN frames by multicast: it cannot where there is no route for it."""

from __future__ import annotations

import socket

import pytest

GROUP = "239.74.163.2"


def skip_without_multicast() -> None:
    """Skip the test, saying why, where the system refuses to join a multicast group."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            membership = socket.inet_aton(GROUP) + socket.inet_aton("0.0.0.0")
            probe.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            pytest.skip(f"no multicast here ({error.strerror}): add a route, such as `ip route add 224.0.0.0/4 dev lo`")
