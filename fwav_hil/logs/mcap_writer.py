"""Writing MCAP, thousands of messages at a time.

The library's own writer takes ten microseconds for each message, several times what making it takes. Here the messages of
a chunk, and the index of a chunk, are put together as arrays; every other record is the library's.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import BinaryIO, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

_MESSAGE = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_BEHIND_LENGTH = _MESSAGE.itemsize - 9
_CHUNK_BYTES = 1 << 20
_LEVEL = 1


class _Pending(NamedTuple):
    """A chunk on its way: its records, what is made of them, and of each message channel, time and place in the chunk."""

    records: bytes
    compressed: Future[bytes]
    channels: npt.NDArray[np.int64]
    times_ns: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]


class McapWriter:
    """Writes schemas, channels and messages to a stream. `finish` ends the file; leaving the block lets go of the thread.

    A chunk is compressed by that thread while the next one is made.
    """

    def __init__(self, stream: BinaryIO, library: str) -> None:
        self._stream = stream
        self._compress = zstandard.ZstdCompressor(level=_LEVEL).compress
        self._thread = ThreadPoolExecutor(1)
        self._pending: _Pending | None = None
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._counts = np.zeros(1, dtype=np.int64)
        self._first_ns, self._last_ns = 0, 0
        self._stream.write(MCAP0_MAGIC)
        self._write(Header(profile="", library=library))

    def add_schema(self, name: str, data: bytes) -> int:
        """Add a JSON schema; returns its number."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, data=data, encoding="jsonschema", name=name))
        self._write(self._schemas[-1])
        return len(self._schemas)

    def add_channel(self, topic: str, schema: int) -> int:
        """Add a topic of JSON messages of that schema; returns its number."""
        number = len(self._channels) + 1
        self._channels.append(Channel(id=number, topic=topic, message_encoding="json", schema_id=schema, metadata={}))
        self._counts = np.append(self._counts, 0)
        self._write(self._channels[-1])
        return number

    def add_messages(
        self,
        channels: npt.NDArray[np.int64],
        times_ns: npt.NDArray[np.int64],
        sequences: npt.NDArray[np.int64],
        bodies: Sequence[bytes],
    ) -> None:
        """Write messages in this order: of each its channel, time, sequence number and body."""
        sizes = np.fromiter(map(len, bodies), dtype=np.int64, count=len(bodies)) + _MESSAGE.itemsize
        ends = np.cumsum(sizes)
        start = 0
        while start < len(bodies):
            before = ends[start] - sizes[start]
            stop = max(start + 1, int(np.searchsorted(ends, before + _CHUNK_BYTES)))
            part = slice(start, stop)
            self._write_chunk(
                channels[part], times_ns[part], sequences[part], bodies[start:stop], sizes[part], ends[part] - before
            )
            start = stop

    def _write_chunk(
        self,
        channels: npt.NDArray[np.int64],
        times_ns: npt.NDArray[np.int64],
        sequences: npt.NDArray[np.int64],
        bodies: Sequence[bytes],
        sizes: npt.NDArray[np.int64],
        ends: npt.NDArray[np.int64],
    ) -> None:
        heads = np.zeros(len(bodies), dtype=_MESSAGE)
        heads["opcode"], heads["channel"], heads["sequence"] = Opcode.MESSAGE, channels, sequences
        heads["length"] = sizes - (_MESSAGE.itemsize - _BEHIND_LENGTH)
        heads["log"] = heads["publish"] = times_ns
        each = heads.view(f"V{_MESSAGE.itemsize}").tolist()
        records = b"".join(itertools.chain.from_iterable(zip(each, bodies, strict=True)))
        pending = _Pending(records, self._thread.submit(self._compress, records), channels, times_ns, ends - sizes)
        self._write_pending()
        self._pending = pending

    def _write_pending(self) -> None:
        """Write the chunk that was given to the thread last."""
        if self._pending is None:
            return
        (records, compressed, channels, times_ns, offsets), self._pending = self._pending, None
        packed, first, last = compressed.result(), int(times_ns.min()), int(times_ns.max())
        chunk = Chunk(
            compression="zstd",
            data=packed,
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(records),
            uncompressed_size=len(records),
        )
        begin = self._stream.tell()
        self._write(chunk)
        end = self._stream.tell()
        places = self._write_index(channels, times_ns, offsets)
        self._chunks.append(
            ChunkIndex(
                message_start_time=first,
                message_end_time=last,
                chunk_start_offset=begin,
                chunk_length=end - begin,
                message_index_offsets=places,
                message_index_length=self._stream.tell() - end,
                compression="zstd",
                compressed_size=len(packed),
                uncompressed_size=len(records),
            )
        )
        self._first_ns = first if not self._counts.any() else min(self._first_ns, first)
        self._last_ns = max(self._last_ns, last)
        self._counts += np.bincount(channels, minlength=len(self._counts))

    def _write_index(
        self, channels: npt.NDArray[np.int64], times_ns: npt.NDArray[np.int64], offsets: npt.NDArray[np.int64]
    ) -> dict[int, int]:
        """Write the message index of each channel in a chunk; returns where each one is."""
        order = np.argsort(channels, kind="stable")
        entries = np.stack([times_ns[order], offsets[order]], axis=1).astype("<u8")
        found, starts = np.unique(channels[order], return_index=True)
        places = {}
        for channel, start, stop in zip(found.tolist(), starts, [*starts[1:], len(order)], strict=True):
            places[channel] = self._stream.tell()
            body = entries[start:stop].tobytes()
            head = channel.to_bytes(2, "little") + len(body).to_bytes(4, "little")
            self._stream.write(bytes([Opcode.MESSAGE_INDEX]) + (len(head) + len(body)).to_bytes(8, "little"))
            self._stream.write(head + body)
        return places

    def finish(self) -> None:
        """Write the summary, behind which nothing follows."""
        self._write_pending()
        self._write(DataEnd(data_section_crc=0))
        start = self._stream.tell()
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts={number: int(n) for number, n in enumerate(self._counts.tolist()) if n},
            chunk_count=len(self._chunks),
            message_count=int(self._counts.sum()),
            metadata_count=0,
            message_start_time=self._first_ns,
            message_end_time=self._last_ns,
            schema_count=len(self._schemas),
        )
        data = b""
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
        ]
        offsets = []
        for opcode, records in groups:
            group = b"".join(map(_encoded, records))
            offsets.append(SummaryOffset(opcode, start + len(data), len(group)))
            data += group
        offsets_start = start + len(data)
        data += b"".join(map(_encoded, offsets))
        self._stream.write(data)
        whole = _encoded(Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=0))
        crc = zlib.crc32(whole[:-4], zlib.crc32(data))  # of the summary and of the footer up to the checksum itself
        self._stream.write(whole[:-4] + crc.to_bytes(4, "little") + MCAP0_MAGIC)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown()

    def _write(self, record: McapRecord) -> None:
        self._stream.write(_encoded(record))


def _encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    encoded: bytes = builder.end()  # type: ignore[no-untyped-call]
    return encoded
