"""Every request for a file is refused, and only requests are."""

from __future__ import annotations

import random

from pymavlink.dialects.v20 import common

from protocol.wire.codec import FrameReader, FrameWriter
from protocol.wire.file_transfer import FILE_TRANSFER, encode_refusal

OPEN, NAK, UNKNOWN_COMMAND = 4, 129, 7


def asked(opcode: int, target: tuple[int, int] = (1, 1), sequence: int = 300) -> bytes | None:
    request = [sequence & 0xFF, sequence >> 8, 5, opcode, 3, 0, 0, 0, 0, 0, 0, 0, *b"abc"]
    message = common.MAVLink_file_transfer_protocol_message(0, *target, [*request, *bytes(251 - len(request))])
    (frame,) = FrameReader(is_datagram=True).read(message.pack(common.MAVLink(None, 255, 190)))
    return encode_refusal(frame.payload, (1, 1), (255, 190))


def test_a_request_gets_a_nak_with_the_next_number() -> None:
    payload = asked(OPEN)
    assert payload is not None
    (answer,) = common.MAVLink(None).parse_buffer(FrameWriter(1, 1).seal(FILE_TRANSFER, payload))
    assert (answer.target_system, answer.target_component) == (255, 190)
    content = bytes(answer.payload)
    assert int.from_bytes(content[:2], "little") == 301
    assert content[2:6] == bytes((5, NAK, 1, OPEN))
    assert content[12] == UNKNOWN_COMMAND
    assert content[13:] == bytes(251 - 13)


def test_answers_and_requests_to_others_are_left_alone() -> None:
    assert asked(NAK) is None
    assert asked(OPEN, (2, 1)) is None


def test_any_length_of_payload_is_taken() -> None:
    payload = random.Random(1).randbytes(254)
    for length in range(255):
        encode_refusal(payload[:length], (1, 1), (255, 190))
