"""Logs read with another dialect: one of pymavlink's, or a file of definitions."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import matrixpilot

from protocol.errors import UsageError
from protocol.logs.dialect import choose, layouts, layouts_by_name, unit
from protocol.logs.scan import scan_tlog
from protocol.logs.tables import tables
from tests.fwav_hil.logs.conftest import Shell, flight_log, shell
from tests.protocol.logs.log_records import CLASHING, FOREIGN, Pen

__all__ = ["flight_log", "shell"]

DEFINITIONS = """<?xml version="1.0"?>
<mavlink>
  <include>{include}</include>
  <messages>
    <message id="{number}" name="FLAPPER_STATE">
      <description>ours</description>
      <field type="uint8_t" name="system">ours too</field>
      <field type="float[4]" name="angles" units="rad">of the wings</field>
      <field type="char[10]" name="name">-</field>
      <extensions/>
      <field type="uint16_t" name="more">-</field>
    </message>
  </messages>
</mavlink>
"""


@pytest.fixture(autouse=True)
def widest_again() -> Iterator[None]:
    yield
    choose(None)


def test_a_dialect_of_pymavlinks_by_name() -> None:
    pen = Pen(matrixpilot)
    data = b"".join(pen.record(number).data for number in (*FOREIGN, CLASHING) for _ in range(3))
    assert tables(scan_tlog(data)) == {}
    choose("matrixpilot")
    made = tables(scan_tlog(data))
    assert {name: len(table) for name, table in made.items()} == {
        matrixpilot.mavlink_map[number].msgname: 3 for number in (*FOREIGN, CLASHING)
    }
    choose(None)
    assert tables(scan_tlog(data)) == {}


def test_every_message_of_a_definition_file_is_as_in_pymavlinks_module(tmp_path: Path) -> None:
    from pymavlink.dialects.v20 import common

    # The definitions behind the modules are not installed with them. Made of a module they lack where extensions begin, which
    # checksums leave out.
    lines = ["<mavlink><messages>"]
    for message in common.mavlink_map.values():
        lines.append(f'<message id="{message.id}" name="{message.msgname}"><description>-</description>')
        kinds = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        lengths = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))
        for name in message.fieldnames:
            length = f"[{lengths[name]}]" if lengths[name] else ""
            lines.append(f'<field type="{kinds[name]}{length}" name="{name}">-</field>')
        lines.append("</message>")
    lines.append("</messages></mavlink>")
    (tmp_path / "made.xml").write_text("\n".join(lines))
    choose(str(tmp_path / "made.xml"))
    same = 0
    for number, message in common.mavlink_map.items():
        ours = layouts()[number]
        assert (ours.name, ours.size) == (message.msgname, message.unpacker.size)
        same += ours.crc_seed == message.crc_extra and ours.fields == tuple(message.ordered_fieldnames)
    assert same > 100  # those without extensions


def test_a_file_of_definitions_with_what_it_includes(tmp_path: Path) -> None:
    (tmp_path / "ours.xml").write_text(DEFINITIONS.format(include="theirs.xml", number=54_000))
    (tmp_path / "theirs.xml").write_text(
        DEFINITIONS.format(include="ours.xml", number=54_001).replace(
            "FLAPPER", "OTHER"
        )  # which includes ours: no circle
    )
    choose(str(tmp_path / "ours.xml"))
    assert set(layouts_by_name()) == {"FLAPPER_STATE", "OTHER_STATE"}
    assert unit("FLAPPER_STATE", "angles") == "rad"
    layout = layouts_by_name()["FLAPPER_STATE"]
    assert layout.fields == ("angles", "system", "name", "more")
    from protocol.wire import framing

    payload = np.arange(4, dtype="<f4").tobytes() + b"\x07" + b"left".ljust(10, b"\0") + b"\x01\x02"
    body = bytes([len(payload), 0, 0, 1, 1, 1]) + (54_000).to_bytes(3, "little") + payload
    crc = framing.checksum(body, 0, len(body), layout.crc_seed)
    row = tables(scan_tlog(b"\xfd" + body + crc.to_bytes(2, "little")))["FLAPPER_STATE"][0]
    assert (row["system"], row["system_2"], row["name"], row["more"]) == (1, 7, b"left", 0x0201)
    assert row["angles"].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("nowhere", "", "there is none of that name; choose a file"),
        ("no.xml", None, "No such file"),
        ("bad.xml", "<mavlink><messages><message", "cannot read the definitions in"),
        ("bad.xml", '<mavlink><messages><message id="1" name="A"><field type="what" name="a"/></message></messages></mavlink>',
         "unknown type"),
        ("empty.xml", "<mavlink></mavlink>", "there is no message in it"),
        ("../os", "", "there is none of that name"),
    ],
)  # fmt: skip
def test_what_is_no_dialect_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: str | None, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    if content is not None and name.endswith(".xml"):
        (tmp_path / name).write_text(content)
    with pytest.raises(UsageError) as caught:
        choose(name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_log_command_takes_it(shell: Shell, flight_log: Path) -> None:
    names = {
        row["name"] for row in json.loads(shell("info", flight_log, "--dialect", "minimal", "--json", "-").out)["types"]
    }
    assert names == {"UNKNOWN_93", "UNKNOWN_138", "UNKNOWN_253"}
    assert {row["name"] for row in json.loads(shell("info", flight_log, "--json", "-").out)["types"]} == {
        "ATT_POS_MOCAP", "HIL_ACTUATOR_CONTROLS", "STATUSTEXT",
    }  # fmt: skip
    assert "UNKNOWN_138" in shell("dump", flight_log, "--dialect", "minimal").out
    for command in (("plot", flight_log, "A.b"), ("export", flight_log, "--to", "csv"), ("dump", flight_log)):
        ended = shell(*command, "--dialect", "nowhere")
        assert (ended.code, "there is none of that name" in ended.err) == (2, True)
