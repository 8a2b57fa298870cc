"""The table of what is said, against the dialect and the mapping."""

from __future__ import annotations

import pytest

from protocol.wire import file_transfer, mapping, parameter_mapping
from protocol.wire import truth_mapping as truth_map
from protocol.wire.codec import Layout, layout
from protocol.wire.streams import HEARTBEAT_TIMEOUT_NS, STREAMS, End, Stream, markdown_table, stream

SECOND_NS = 1_000_000_000


class TestTable:
    def test_it_names_every_message_that_the_mapping_knows_and_no_other(self) -> None:
        maps = (mapping, truth_map, parameter_mapping, file_transfer)
        mapped = {value.name for one in maps for value in vars(one).values() if isinstance(value, Layout)}
        assert {row.message for row in STREAMS} == mapped
        assert len(STREAMS) == len(mapped)

    @pytest.mark.parametrize("row", STREAMS, ids=lambda row: row.message)
    def test_a_row_is_a_message_of_the_dialect_with_a_sender_a_rate_and_a_rule(self, row: Stream) -> None:
        found = stream(row.message)
        assert found is row
        assert layout(found.message).name == found.message
        assert found.sender in End
        assert found.rate_hz is None or found.rate_hz > 0.0
        assert found.rule

    def test_a_message_without_a_row_is_refused(self) -> None:
        with pytest.raises(KeyError, match="GPS_RAW_INT"):
            stream("GPS_RAW_INT")

    def test_feedback_and_tick_come_from_the_emulator_and_commands_from_the_controller(self) -> None:
        assert stream("ATT_POS_MOCAP").sender is End.EMULATOR
        assert stream("HIL_SENSOR").sender is End.EMULATOR
        assert stream("HIL_ACTUATOR_CONTROLS").sender is End.CONTROLLER
        assert stream("HEARTBEAT").sender is End.BOTH

    def test_a_peer_is_lost_after_three_heartbeats(self) -> None:
        assert stream("HEARTBEAT").rate_hz == 1.0
        assert HEARTBEAT_TIMEOUT_NS == 3 * SECOND_NS

    def test_the_printed_table_has_a_row_for_each_stream(self) -> None:
        lines = list(markdown_table())
        assert len(lines) == 2 + len(STREAMS)
        for line, row in zip(lines[2:], STREAMS, strict=True):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            rate = f"{row.rate_hz:g} Hz" if row.rate_hz else "-"
            assert cells == [row.message, row.sender.value, rate, row.rule]
