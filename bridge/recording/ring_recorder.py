"""The recorder of the loop: it passes frames to a separate process through a ring buffer, and never waits for a disk.

It does for one link what `thread_recorder.Recorder` does with a thread, without that thread's use of the interpreter. A
kill -9 of the loop's process loses nothing that was handed over: the writer process sees its stdin end and writes the
rest. If the writer dies, a new one continues at the byte where it stopped.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from bridge.recording.recorder import SidecarLog, Tell
from bridge.recording.ring import ByteRing
from bridge.recording.sidecar import LinkOfLog
from bridge.timing.clock import Clock, MonotonicClock
from protocol.logs.scan import scan_tlog

CAPACITY_BYTES: Final = 16 << 20
"""Over a minute of a 1 kHz loop: the disk may stall this long before a frame is lost."""
_PATIENCE_S: Final = 30.0
_LOOK_NS: Final = 1_000_000


class RingRecorder(SidecarLog):
    """A log of one link, written by another process, with its sidecar.

    After a write error `tell` is called with one message at the next `flush`, and the writer retries as long as the ring
    has space; without `tell` the message is raised as RunFolderError, once.

    restarts    writers that died and were replaced
    may_wait    whether `hand_over` waits for space (lockstep) or counts frames as lost (real time)
    """

    def __init__(
        self,
        path: Path,
        link: LinkOfLog,
        *,
        stamps: str,
        source: dict[str, Any],
        may_wait: bool,
        tell: Tell | None = None,
        capacity: int = CAPACITY_BYTES,
        clock: Clock | None = None,
    ) -> None:
        """Begin the log with its sidecar; see `new_sidecar`. Raises RunFolderError where that fails."""
        super().__init__(path, (link,), stamps=stamps, source=source, tell=tell)
        self.restarts = self.deepest_bytes = 0
        self._may_wait = may_wait
        self._clock = clock or MonotonicClock()
        self._handed_over = self._pending_frames = 0
        with self._beginning():
            self.ring = ByteRing.create(capacity)
            self._writer = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        descriptors = (self.ring.descriptor, self._file.fileno())
        arguments = (str(self.ring.descriptor), str(self.ring.capacity), str(self._file.fileno()))
        return subprocess.Popen(
            [sys.executable, "-S", "-m", "bridge.recording.log_writer", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=descriptors,
            cwd=Path(__file__).resolve().parents[2],
        )

    @property
    def writer_pid(self) -> int:
        """Process id of the writer."""
        return self._writer.pid

    def write(self, t_us: int, frame: bytes) -> None:
        """Add one frame; `hand_over` passes it to the writer."""
        self._append(t_us, frame)
        self._pending_frames += 1

    def hand_over(self) -> None:
        """Pass the added frames to the writer."""
        if not self._pending:
            return
        if not self.ring.put(self._pending) and not (self._may_wait and self._put_patiently()):
            self.lost += self._pending_frames
        else:
            self._handed_over += self._pending_frames
        self._pending.clear()
        self._pending_frames = 0

    def _put_patiently(self) -> bool:
        """Wait for space, as long as the writer reports no error; whether the frames fitted."""
        give_up_ns = self._clock.now_ns() + round(_PATIENCE_S * 1e9)
        while not self.ring.put(self._pending):
            if self.ring.error or self._clock.now_ns() > give_up_ns:
                return False
            self._see_to_the_writer()
            self._clock.sleep_until_ns(self._clock.now_ns() + _LOOK_NS)
        return True

    def flush(self) -> None:
        """Hand over, and check the writer: quick, unless the writer has died."""
        self.hand_over()
        self.deepest_bytes = max(self.deepest_bytes, self.ring.put_bytes - self.ring.taken_bytes)
        self._see_to_the_writer()
        if self.ring.error:
            self._say(f"cannot write the log {self.path}: {os.strerror(self.ring.error)}")

    def _see_to_the_writer(self) -> None:
        if self._writer.poll() is not None:
            self.restarts += 1
            self._end_input()
            self.ring.take_over_at(os.fstat(self._file.fileno()).st_size)
            self._writer = self._start()

    def close(self) -> None:
        """Write the rest, and the end of the log to the sidecar; may be called again.

        After a write error the log ends with its last complete record; raises RunFolderError unless that was reported before.
        """
        if self._file.closed:
            return
        self.hand_over()
        self._end_input()
        try:
            self._writer.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._writer.kill()
            self._writer.wait()
        size = os.fstat(self._file.fileno()).st_size
        if size < self.ring.put_bytes:  # the writer died, or had a write error: one more attempt
            self.ring.take_over_at(size)
            self.ring.write_to(self._file.fileno(), self.ring.put_bytes)
        problem = f"cannot write the log {self.path}: {os.strerror(self.ring.error)}" if self.ring.error else ""
        if os.fstat(self._file.fileno()).st_size < self.ring.put_bytes:
            self._cut_off()
        self._file.close()
        self.ring.close()
        self._end(
            problem,
            frames=self._handed_over,
            bytes=self.path.stat().st_size,
            error=problem or None,
            writer={"restarts": self.restarts, "deepest_bytes": self.deepest_bytes},
        )

    def _end_input(self) -> None:
        """Close the writer's standard input: if it still runs, it then writes the rest and exits."""
        if self._writer.stdin:
            self._writer.stdin.close()

    def _cut_off(self) -> None:
        """Truncate the log after its last complete record, and count the missing frames."""
        frames = scan_tlog(self.path).frames
        whole = int(frames[-1]["offset"]) + int(frames[-1]["length"]) if len(frames) else 0
        with contextlib.suppress(OSError):
            os.ftruncate(self._file.fileno(), whole)
        self.lost += self._handed_over - len(frames)
        self._handed_over = len(frames)
