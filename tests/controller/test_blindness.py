"""A controller sees positions and attitude only: whatever else the wire says, its commands stay the same to the byte."""

from __future__ import annotations

import math
import random
import threading

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from controller.laws.law import make_law
from controller.laws.registry import LAWS
from controller.options import ControllerOptions
from controller.process import serve, warm_up
from protocol.scenario import Scenario
from protocol.wire import mapping
from protocol.wire.codec import Layout, layout
from tests.loop import scenario_of

TICKS = 60
NOISY = ("HIL_GPS", "HIL_STATE_QUATERNION", "ODOMETRY")


def noise_payload(message: Layout, generator: random.Random, *, keep_time: bytes = b"") -> bytes:
    """Random bytes, with NaN in every float now and then; the first bytes are `keep_time`."""
    data = bytearray(generator.randbytes(message.size))
    for name in message.dtype.names or ():
        kind, offset = message.dtype.fields[name][:2]  # type: ignore[index]
        if kind.base == np.float32 and generator.random() < 0.5:
            for at in range(offset, offset + kind.itemsize, 4):
                data[at : at + 4] = np.float32(math.nan).tobytes()
    data[: len(keep_time)] = keep_time
    return bytes(data)


def commands(scenario: Scenario, generator: random.Random | None) -> list[bytes]:
    """The payloads of all commands that a flight of fixed poses gets; with a generator, all else on the wire is noise."""
    near, far = memory_pair()
    answers: list[bytes] = []
    law = make_law(scenario.law, scenario)
    warm_up(scenario, law)
    options = ControllerOptions(link="-", wait_s=10.0)
    thread = threading.Thread(target=lambda: serve(scenario, law, far, options, lambda _event: None, StopFlag()))
    with near, far:
        thread.start()
        emulator = Endpoint(near, 1, scenario.wire.emulator_component)
        version = mapping.encode_version(scenario.digest())
        emulator.send([emulator.seal(mapping.VERSION, version)])
        poses = np.random.default_rng(5).normal(0.0, 0.05, (TICKS, 6)) + 0.1
        for tick in range(TICKS):
            t_ns = tick * scenario.period_ns
            readings = np.zeros(13)
            payload = mapping.encode_tick(t_ns, readings)
            frames = []
            if generator:
                # The instance id stays 0: it says which sensor speaks, and instance 0 is the tick.
                payload = noise_payload(mapping.TICK, generator, keep_time=payload[:8])[:64]
                for name in NOISY:
                    frames.append(emulator.seal(layout(name), noise_payload(layout(name), generator)))
            frames.append(emulator.seal(mapping.POSE, mapping.encode_pose(t_ns, poses[tick])))
            frames.append(emulator.seal(mapping.TICK, payload))
            emulator.send(frames)
            while len(answers) <= tick:
                received = emulator.receive(5.0)
                assert received, "no answer"
                answers += [f.payload for f in received if f.message_id == mapping.COMMAND.message_id]
        emulator.send([emulator.seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat(ending=True))])
        thread.join(10.0)
        assert not thread.is_alive()
    return answers


@pytest.mark.parametrize("law", [name for name, entry in LAWS.items() if not entry.needs_velocity])
def test_noise_in_every_other_field_changes_no_byte_of_any_command(law: str) -> None:
    scenario = scenario_of("flapper", law=law)
    quiet = commands(scenario, None)
    assert len(set(quiet)) == TICKS  # the commands do depend on the poses
    assert commands(scenario, random.Random(1)) == quiet
    assert commands(scenario, random.Random(2)) == quiet
