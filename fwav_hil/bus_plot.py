"""The gears as recorded on the motor bus: shaft angles before and after, from the bus log alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fwav_hil.plots import gear_panels
from protocol.can_frame import CanFrame
from protocol.messages import FloatArray
from protocol.motors.motor_protocol import DRIVES
from protocol.motors.simulation_sync import decode_encoders
from protocol.scenario import Scenario


def read_encoders(log: Path) -> list[FloatArray]:
    """For each axis (n, 2): motor and output angle, rad, in the order of the log."""
    import can

    points: list[list[tuple[float, float]]] = [[] for _ in range(DRIVES)]
    with can.LogReader(log) as messages:
        for message in messages:
            seen = decode_encoders(CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id))
            if seen:
                points[seen[0]].append(seen[1:])
    return [np.array(of_axis).reshape(-1, 2) for of_axis in points]


def plot_bus(log: Path, scenario: Scenario, title: str) -> Path:
    """Plot u against tau, computed from the encoder frames on the bus; saved beside the log."""
    path = log.with_name("hysteresis_bus.png")
    unit = np.array(scenario.actuators.scale) / scenario.motor.travel_rad
    curves = [points * unit[axis] for axis, points in enumerate(read_encoders(log))]
    gear_panels(path, f"{title}: gears from the encoders on the bus, u against tau", curves)
    return path
