"""FILE_TRANSFER_PROTOCOL: every request is refused. Source: the MAVLink FTP guide.

Ground stations first request a file of parameters, and wait for seconds without an answer; after a NAK they use the
parameter protocol at once.

    payload   sequence (2 bytes) | session | opcode | size | opcode asked for | burst complete | 0 | offset (4) | data
"""

from __future__ import annotations

from protocol.wire.codec import layout

FILE_TRANSFER = layout("FILE_TRANSFER_PROTOCOL")

_NAK = 129
_UNKNOWN_COMMAND = 7
_HEADER = 12
_LARGEST_REQUEST = 127


def encode_refusal(payload: bytes, me: tuple[int, int], asker: tuple[int, int]) -> bytes | None:
    """FILE_TRANSFER_PROTOCOL payload that refuses a request; None if it is no request, or not for (system, component) `me`."""
    values = FILE_TRANSFER.unpack_fields(payload)
    request = bytes(values["payload"])
    if values["target_system"] not in (0, me[0]) or values["target_component"] not in (0, me[1]):
        return None
    if request[3] > _LARGEST_REQUEST:
        return None  # a response, not a request
    sequence = (int.from_bytes(request[:2], "little") + 1) & 0xFFFF
    answer = sequence.to_bytes(2, "little") + bytes((request[2], _NAK, 1, request[3])) + bytes(_HEADER - 6)
    return FILE_TRANSFER.pack_fields(
        target_system=asker[0], target_component=asker[1], payload=[*answer, _UNKNOWN_COMMAND]
    )
