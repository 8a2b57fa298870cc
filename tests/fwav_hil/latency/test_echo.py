"""The bare echo, as a process: a tick's bytes there, a command's back."""

from __future__ import annotations

import numpy as np
import pytest

from bridge.links.link import open_link
from fwav_hil.latency.echo import COMMAND_BYTES, TICK_BYTES
from fwav_hil.latency.peers import EMULATOR, _child
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter
from tests.contracts.link_contract import receive
from tests.frames import command_frame, tick_frames
from tests.loop import scenario_of


@pytest.mark.processes
def test_it_gives_back_the_first_bytes() -> None:
    with _child("fwav_hil.latency.echo") as port, open_link(f"udpout://127.0.0.1:{port}") as link:
        for number in range(3):
            question = bytes([number]) + bytes(range(125))
            link.send(question)
            assert receive(link) == question[:COMMAND_BYTES]


def test_the_sizes_are_those_of_a_tick_and_its_command() -> None:
    scenario = scenario_of("flapper")
    tick = tick_frames(FrameWriter(*EMULATOR), 4_000_000, np.full(6, 0.123), np.full(13, 9.81))
    scale = np.array(scenario.actuators.scale)
    command = command_frame(FrameWriter(1, 1), 4_000_000, 0.3 * scale, scale, lockstep=False)
    assert mapping.COMMAND.message_id == 93
    assert len(command) == COMMAND_BYTES
    assert len(tick) == TICK_BYTES
