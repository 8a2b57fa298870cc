"""A serial line: 8 data bits, no parity, 1 stop bit, no flow control, raw. POSIX.

pyserial opens and configures the line; reads and writes use its file descriptor directly, because pyserial's `write` waits
for buffer space even after all is written, and setting its `timeout` configures the whole line again.
"""

from __future__ import annotations

import errno
import os
import select

import serial

from bridge.links.byte_stream import CHUNK_BYTES, SEND_TIMEOUT_S, StreamLink
from bridge.links.link import LinkUri
from protocol.errors import LinkError, LinkInUseError, LinkUriError


class SerialLink(StreamLink):
    """One end of a serial line, locked for this process (other programs that ask for the lock are refused).

    `low_latency` tells whether the driver accepted low-latency mode: without it USB adapters hold bytes back for up to
    16 ms, too long for a control loop.

    Raises LinkInUseError where the device is in use, LinkUriError where it does not support the baud rate, LinkError where
    there is no such device, it is not a serial line or access is not permitted.
    """

    def __init__(self, uri: LinkUri, *, connect_timeout_s: float = 0.0, send_timeout_s: float = SEND_TIMEOUT_S) -> None:
        """Open the device; `connect_timeout_s` is ignored."""
        super().__init__(uri.text, send_timeout_s=send_timeout_s)
        self._device = uri.path
        try:
            self._port = serial.Serial(uri.path, uri.baud, timeout=0, write_timeout=0, exclusive=True)
        except serial.SerialException as error:
            raise _cannot_open(uri, error) from error
        except (ValueError, OverflowError) as error:
            raise LinkUriError(
                f"{uri.text!r} is not a link URI: {uri.path} does not support {uri.baud} baud ({error}); write for example "
                f"serial://{uri.path}:921600"
            ) from error
        self.low_latency = _ask_for_low_latency(self._port)

    def _read(self) -> bytes:
        # Check first: without data a read of a raw line returns b"", the same as on a line that is gone.
        if not select.select((self._fileno(),), (), (), 0)[0]:
            raise BlockingIOError
        return os.read(self._fileno(), CHUNK_BYTES)

    def _write(self, data: memoryview) -> int:
        return os.write(self._fileno(), data)

    def _fileno(self) -> int:
        if self._closed:
            raise self._ended(None)
        return int(self._port.fileno())

    def close(self) -> None:
        """Release the device."""
        self._closed = True
        self._port.close()

    @property
    def peer(self) -> str:
        """The device: the other end of a serial line has no name."""
        return self._device


def _cannot_open(uri: LinkUri, error: serial.SerialException) -> LinkError:
    if error.errno in (errno.EAGAIN, errno.EBUSY):  # EAGAIN: the lock is held
        return LinkInUseError(f"{uri.text}: {uri.path} is taken: stop the other process or choose another with --link")
    if error.errno in (errno.EACCES, errno.EPERM):
        return LinkError(f"{uri.text}: no permission for {uri.path}: add the user to the group that owns it (dialout)")
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return LinkError(f"{uri.text}: there is no device {uri.path}: plug it in or choose another with --link")
    return LinkError(f"{uri.text}: cannot open {uri.path} as a serial line: {error}")


def _ask_for_low_latency(port: serial.Serial) -> bool:
    try:
        port.set_low_latency_mode(True)
    except (OSError, ValueError, NotImplementedError):  # most lines that are not USB have no such mode
        return False
    return True
