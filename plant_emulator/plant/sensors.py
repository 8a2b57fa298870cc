"""The emulator's sensors: pose with noise for the laws; IMU, pressure and magnetic field for real autopilots.

Each sensor draws from a random generator of its own, keyed by its name, once for every tick whether or not the frame
arrives: adding a sensor does not change another sensor's noise.
"""

from __future__ import annotations

import math
import zlib

import numpy as np

from plant_emulator.plant.rigid_body import body_rates
from protocol.compiled import compiled
from protocol.messages import FloatArray
from protocol.rotations import rotate_to_body
from protocol.scenario import World

NOISE_BLOCK = 1024
"""Number of ticks whose noise is drawn at once."""
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

    def __init__(self, seed: int) -> None:
        self._generator = sensor_generator(seed, "position")

    def draw(self, count: int) -> FloatArray:
        """The standard normal numbers (count, 6) of the next `count` ticks."""
        return self._generator.standard_normal((count, 6))


@compiled
def inertial_readings(
    motion: FloatArray, force: FloatArray, field: FloatArray, altitude: float, readings: FloatArray
) -> None:
    """Fill readings (13,) except the last; force (3,) is the specific force (m/s^2), altitude that of the origin."""
    for i in range(3):
        readings[i] = force[i]
    readings[3], readings[4], readings[5] = body_rates(motion)
    readings[6], readings[7], readings[8] = rotate_to_body(
        motion[3], motion[4], motion[5], field[0], field[1], field[2]
    )
    altitude -= motion[2]
    # Above 44 km the formula's pressure is zero; without the bound its power would not be a real number.
    readings[9] = 1013.25 * max(0.0, 1.0 - 2.25577e-5 * altitude) ** 5.25588
    readings[10] = 0.0
    readings[11] = altitude


class InertialSensors:
    """The rest of HIL_SENSOR, without noise: true specific force, body rates, magnetic field, static pressure.

    Specific force is (a - g) in the body frame: the force of the whole wrench over the mass. Pressure is the standard
    atmosphere's.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._field = np.array(world.magnetic_field_ned)
        self._readings = np.empty(13)
        self._readings[12] = world.temperature_celsius

    def measure(self, motion: FloatArray, force: FloatArray) -> FloatArray:
        """The readings (13,) for `mapping.encode_tick`, of a specific force (3,); the next call overwrites them."""
        inertial_readings(motion, force, self._field, self._world.altitude, self._readings)
        return self._readings

    def geodetic(self, motion: FloatArray) -> tuple[float, float, float]:
        """Latitude (deg), longitude (deg), altitude (m) of the vehicle, on a sphere around its origin."""
        latitude = self._world.latitude_deg + math.degrees(motion[0] / EARTH_RADIUS)
        east = motion[1] / (EARTH_RADIUS * math.cos(math.radians(self._world.latitude_deg)))
        return latitude, self._world.longitude_deg + math.degrees(east), self._world.altitude - motion[2]
