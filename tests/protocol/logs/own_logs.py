"""Small logs as autopilots write them of themselves: ArduPilot's .BIN and .log, PX4's .ulg."""

from __future__ import annotations

import struct
from typing import Any

# --- ArduPilot: 0xA3 0x95 type body; FMT (128) says what each type is: type, length, name[4], format[16], labels[64].

GPS_WEEK, GPS_MS = 2286, 172_800_000
FORMATS = {
    128: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", "<BB4s16s64s"),
    10: ("IMU", "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", "<QBfff"),
    11: ("GPS", "QBIHLLe", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt", "<QBIHiii"),
    12: ("MSG", "QZ", "TimeUS,Message", "<Q64s"),
    13: ("OLD", "Hc", "Value,Centi", "<Hh"),
    14: ("ISBD", "Qa", "TimeUS,x", "<Q64s"),
}


def dataflash(number: int, *values: Any) -> bytes:
    return b"\xa3\x95" + bytes([number]) + struct.pack(FORMATS[number][3], *values)


def format_record(number: int, name: str, letters: str, labels: str, size: int) -> bytes:
    """A FMT record; `size` is that of the body of the type's records."""
    return dataflash(128, number, 3 + size, name.encode(), letters.encode(), labels.encode())


def ardupilot_log() -> bytes:
    data = b"".join(
        format_record(number, name, letters, labels, struct.calcsize(layout))
        for number, (name, letters, labels, layout) in FORMATS.items()
    )
    data += dataflash(12, 1000, b"ArduCopter V4.5.0")
    for row in range(20):
        data += dataflash(10, 1_000_000 + 2500 * row, row % 2, 0.1 * row, -0.5, 1e-3)
        if row % 5 == 0:
            data += dataflash(11, 1_001_000 + 2500 * row, 3, GPS_MS + row, GPS_WEEK, 473977411 + row, 85455927, 48809)
            data += dataflash(13, row, -150)
            data += dataflash(14, 1_001_500 + 2500 * row, struct.pack("<32h", *range(32)))
    return data


def ardupilot_text_log() -> bytes:
    """The same kinds of records as lines, as a ground station writes them."""
    lines = ["1", "ArduCopter V3.2", "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    lines += [
        f"FMT, {number}, {3 + struct.calcsize(layout)}, {name}, {letters}, {labels}"
        for number, (name, letters, labels, layout) in FORMATS.items()
        if name in ("IMU", "GPS", "MSG", "OLD")
    ]
    lines.append("FMT, 15, 20, MODE, QMB, TimeUS,Mode,ModeNum")
    lines.append("MSG, 1000, ArduCopter V3.2, and more")
    lines.append("MODE, 1500, STABILIZE, 0")
    for row in range(20):
        lines.append(f"IMU, {1_000_000 + 2500 * row}, {row % 2}, {0.1 * row}, -0.5, NaN")
        if row % 5 == 0:
            lines.append(f"GPS, {1_001_000 + 2500 * row}, 3, {GPS_MS + row}, {GPS_WEEK}, 47.3977411, 8.5455927, 488.09")
            lines.append(f"OLD, {row}, -1.5")
    return "\r\n".join(lines).encode() + b"\r\n"


# --- PX4: header, then messages of size (u16), type and body: F format, A subscription, D data, O dropout.


def ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog_header(start_us: int = 500) -> bytes:
    return b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start_us) + ulog_message("B", bytes(40))


def ulog_subscription(instance: int, number: int, name: str) -> bytes:
    return ulog_message("A", struct.pack("<BH", instance, number) + name.encode())


def ulog_key(key: str) -> bytes:
    return bytes([len(key)]) + key.encode()


def px4_log() -> bytes:
    data = ulog_header()
    data += ulog_message("I", ulog_key("char[3] sys_name") + b"PX4")
    data += ulog_message("P", ulog_key("float MPC_XY_P") + struct.pack("<f", 0.95))
    data += ulog_message("P", ulog_key("int32_t SYS_AUTOSTART") + struct.pack("<i", 4001))
    data += ulog_message("F", b"pose:uint64_t timestamp;float[4] q;float x;uint8_t count;uint8_t[3] _padding0;")
    data += ulog_message("F", b"rotor:float rpm;char[4] name;")
    data += ulog_message("F", b"mode:uint64_t timestamp;bool armed;rotor[2] rotors;")
    for number, (instance, name) in enumerate([(0, "pose"), (1, "pose"), (0, "mode")]):
        data += ulog_subscription(instance, number, name)
    for row in range(10):
        for number in (0, 1):
            body = struct.pack("<HQfffffB", number, 1000 + 4000 * row, 1, 0, 0, row, 0.5 * row, number)
            data += ulog_message("D", body)
        if row % 5 == 0:
            rotors = struct.pack("<f4sf4s", 100 + row, b"left", 200, b"r\0\0\0")
            data += ulog_message("D", struct.pack("<HQB", 2, 1001 + 4000 * row, row > 0) + rotors)
    data += ulog_message("L", b"6" + struct.pack("<Q", 20000) + b"[commander] armed")
    data += ulog_message("P", ulog_key("float MPC_XY_P") + struct.pack("<f", 1.5))
    return data + ulog_message("O", struct.pack("<H", 20))
