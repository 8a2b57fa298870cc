"""What the emulator measures: pose with noise for the laws; an IMU, pressure and field for real autopilots.

Each sensor draws from a generator of its own, keyed by its name, once for every tick whether or not the frame arrives:
adding a sensor shifts no other one's noise.
"""

from __future__ import annotations

import math
import zlib

import numpy as np

from plant_emulator.plant.rigid_body import body_rates
from protocol.compiled import compiled
from protocol.messages import FloatArray, PositionSample
from protocol.rotations import rotate_to_body
from protocol.scenario import Noise, World

_BLOCK = 1024
EARTH_RADIUS = 6_371_000.0


def sensor_generator(seed: int, name: str) -> np.random.Generator:
    """The random numbers of the sensor called `name` in a run with this seed."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),))))


@compiled
def add_noise(q: FloatArray, normal: FloatArray, position: float, attitude: float, measured: FloatArray) -> None:
    """Fill measured (6,) with q (6,) plus noise: standard normal (6,) times the deviation of position and attitude."""
    for i in range(3):
        measured[i] = q[i] + position * normal[i]
        measured[3 + i] = q[3 + i] + attitude * normal[3 + i]


class PositionSensor:
    """Position and attitude with Gaussian noise per sample, on the position (m) and on the angles (rad)."""

    def __init__(self, noise: Noise, seed: int) -> None:
        self._noise = noise
        self._generator = sensor_generator(seed, "position")
        self._block = np.empty((0, 6))
        self._at = 0

    def draw(self, count: int) -> FloatArray:
        """The standard normal numbers (count, 6) of the next `count` ticks."""
        return self._generator.standard_normal((count, 6))

    def next_normal(self) -> FloatArray:
        """The standard normal numbers (6,) of the next tick; ask once for every tick."""
        if self._at == len(self._block):
            self._block = self.draw(_BLOCK)
            self._at = 0
        self._at += 1
        return np.asarray(self._block[self._at - 1])

    def measure(self, t_ns: int, motion: FloatArray) -> PositionSample:
        """The sample of the next tick."""
        q = np.empty(6)
        add_noise(motion, self.next_normal(), self._noise.position, self._noise.attitude, q)
        return PositionSample(t_ns, q)


@compiled
def inertial_readings(
    motion: FloatArray, u: FloatArray, mass: float, field: FloatArray, altitude: float, readings: FloatArray
) -> None:
    """Fill readings (13,) but the last; altitude is that of the origin."""
    for i in range(3):
        readings[i] = u[i] / mass
    readings[3], readings[4], readings[5] = body_rates(motion)
    readings[6], readings[7], readings[8] = rotate_to_body(
        motion[3], motion[4], motion[5], field[0], field[1], field[2]
    )
    altitude -= motion[2]
    # Above 44 km the formula has no more air; without the bound its power would be no real number.
    readings[9] = 1013.25 * max(0.0, 1.0 - 2.25577e-5 * altitude) ** 5.25588
    readings[10] = 0.0
    readings[11] = altitude


class InertialSensors:
    """The rest of HIL_SENSOR, without noise: true specific force, body rates, magnetic field, static pressure.

    Specific force is (a - g) in the body frame, which is the wrench of the gears over the mass (a scenario's disturbance
    force is left out of it). Pressure is the standard atmosphere's.
    """

    def __init__(self, mass: float, world: World) -> None:
        self._mass = mass
        self._world = world
        self._field = np.array(world.magnetic_field_ned)
        self._readings = np.empty(13)
        self._readings[12] = world.temperature_celsius

    def measure(self, motion: FloatArray, u: FloatArray) -> FloatArray:
        """The readings (13,) that `mapping.encode_tick` takes; the next call overwrites them."""
        inertial_readings(motion, u, self._mass, self._field, self._world.altitude, self._readings)
        return self._readings

    def geodetic(self, motion: FloatArray) -> tuple[float, float, float]:
        """Latitude (deg), longitude (deg), altitude (m) of the vehicle, on a sphere around its origin."""
        latitude = self._world.latitude_deg + math.degrees(motion[0] / EARTH_RADIUS)
        east = motion[1] / (EARTH_RADIUS * math.cos(math.radians(self._world.latitude_deg)))
        return latitude, self._world.longitude_deg + math.degrees(east), self._world.altitude - motion[2]
