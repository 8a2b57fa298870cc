"""A ring buffer in shared memory: one process writes, another reads, neither waits for the other.

The loop must not wait for a disk, and a writer thread would compete with it for the interpreter; so recorded data goes
through this ring to a separate process (`log_writer`). Only the standard library is imported here, so that this process
starts quickly.

Layout: 64 bytes of header (total bytes put, total bytes taken, error number of the reader's last file write), then the data.
On some machines another core may see two stores in a different order, so the reader only takes bytes whose count it saw at
its previous poll, some milliseconds earlier, or after the writer has ended.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import Final

HEADER_BYTES: Final = 64
_PUT, _TAKEN, _ERROR = range(3)


class ByteRing:
    """One end of a ring in the memory of a file descriptor that both processes hold open."""

    def __init__(self, descriptor: int, capacity: int) -> None:
        self.descriptor = descriptor
        self.capacity = capacity
        self._map = mmap.mmap(descriptor, HEADER_BYTES + capacity)
        self._view = memoryview(self._map)
        self._words = self._view[:HEADER_BYTES].cast("Q")
        self._bytes = self._view[HEADER_BYTES:]

    @classmethod
    def create(cls, capacity: int) -> ByteRing:
        """A new ring; its memory is freed when the last process that holds it ends."""
        if hasattr(os, "memfd_create"):
            descriptor = os.memfd_create("fwav-hil-ring")
        else:
            with tempfile.TemporaryFile() as file:
                descriptor = os.dup(file.fileno())
        os.ftruncate(descriptor, HEADER_BYTES + capacity)
        return cls(descriptor, capacity)

    def put(self, data: bytes | bytearray) -> bool:
        """Write all of `data`, or nothing where it does not fit (False)."""
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
        """Total number of bytes put."""
        return int(self._words[_PUT])

    @property
    def taken_bytes(self) -> int:
        """Total number of bytes taken."""
        return int(self._words[_TAKEN])

    @property
    def error(self) -> int:
        """The error number of the reader's last file write; 0 where it succeeded."""
        return int(self._words[_ERROR])

    def write_to(self, file: int, until: int) -> None:
        """Take the bytes before number `until` and write them to a file descriptor.

        An OSError of the file is stored in `error`; bytes that were not written stay in the ring.
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
        """Continue at that byte after the reading process has died."""
        self._words[_TAKEN] = taken

    def close(self) -> None:
        """Release the memory; calling it again does nothing."""
        if not self._map.closed:
            self._words.release()
            self._bytes.release()
            self._view.release()
            self._map.close()
            os.close(self.descriptor)
