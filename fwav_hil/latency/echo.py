"""The baseline: a UDP echo with the standard library only, with datagrams of the sizes of a tick and its command.

`python -m fwav_hil.latency.echo` writes its port, then answers each datagram with its first 93 bytes; it ends with its parent.
"""

from __future__ import annotations

import socket
import sys

from bridge.process import end_with_parent

TICK_BYTES, COMMAND_BYTES = 126, 93


def main() -> None:
    """Answer until ended."""
    end_with_parent()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        sys.stdout.write(f"{link.getsockname()[1]}\n")
        sys.stdout.flush()
        while True:
            data, sender = link.recvfrom(2048)
            link.sendto(data[:COMMAND_BYTES], sender)


if __name__ == "__main__":
    main()
