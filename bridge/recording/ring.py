"""A ring of bytes in shared memory: one process puts, another takes, neither waits for the other.

The loop must not wait for a disk, and a thread of its own would fight it for the interpreter; so what is to be recorded goes
through such a ring to a process of its own (`log_writer`). Only the standard library is imported here: that process starts
in a moment.

Layout: 64 bytes of header (how many bytes were ever put, how many were taken, the error number of the taker's last write),
then the bytes. Machines differ in whether another core sees two stores in their order, so the taker only takes what it saw
announced one look ago, some milliseconds earlier, or after the putter's end.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import Final

HEADER_BYTES: Final = 64
_PUT, _TAKEN, _ERROR = range(3)


class ByteRing:
    """One end of a ring over the memory behind a file descriptor, which both processes hold open."""

    def __init__(self, descriptor: int, capacity: int) -> None:
        self.descriptor = descriptor
        self.capacity = capacity
        self._map = mmap.mmap(descriptor, HEADER_BYTES + capacity)
        self._view = memoryview(self._map)
        self._words = self._view[:HEADER_BYTES].cast("Q")
        self._bytes = self._view[HEADER_BYTES:]

    @classmethod
    def create(cls, capacity: int) -> ByteRing:
        """A new ring; it goes when the last process that holds it ends."""
        if hasattr(os, "memfd_create"):
            descriptor = os.memfd_create("fwav-hil-ring")
        else:
            with tempfile.TemporaryFile() as file:
                descriptor = os.dup(file.fileno())
        os.ftruncate(descriptor, HEADER_BYTES + capacity)
        return cls(descriptor, capacity)

    def put(self, data: bytes | bytearray) -> bool:
        """Put all of `data`, or nothing where it does not fit (False)."""
        words = self._words
        put, size = words[_PUT], len(data)
        if put + size - words[_TAKEN] > self.capacity:
            return False
        at = put % self.capacity
        room = self.capacity - at
        if size <= room:
            self._bytes[at : at + size] = data
        else:
            self._bytes[at:] = data[:room]
            self._bytes[: size - room] = data[room:]
        words[_PUT] = put + size
        return True

    @property
    def put_bytes(self) -> int:
        """How many bytes were ever put."""
        return int(self._words[_PUT])

    @property
    def taken_bytes(self) -> int:
        """How many bytes were ever taken."""
        return int(self._words[_TAKEN])

    @property
    def error(self) -> int:
        """The error number of the taker's last write; 0 where it went well."""
        return int(self._words[_ERROR])

    def write_to(self, file: int, until: int) -> None:
        """Take what was put before the byte numbered `until`, and write it to a file descriptor.

        An OSError of the file is noted (`error`); what it did not take stays for the next time.
        """
        taken = self.taken_bytes
        try:
            while taken < until:
                at = taken % self.capacity
                end = min(self.capacity, at + until - taken)
                taken += os.write(file, self._bytes[at:end])
                self._words[_TAKEN] = taken
            self._words[_ERROR] = 0
        except OSError as error:
            self._words[_ERROR] = error.errno or -1

    def take_over_at(self, taken: int) -> None:
        """Go on taking at that byte, where the process that took has died."""
        self._words[_TAKEN] = taken

    def close(self) -> None:
        """Let go of the memory; calling it again does nothing."""
        if not self._map.closed:
            self._words.release()
            self._bytes.release()
            self._view.release()
            self._map.close()
            os.close(self.descriptor)
