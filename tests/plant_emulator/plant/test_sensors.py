"""What is measured: noise that no other sensor can shift, and true inertial readings for real autopilots."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plant_emulator.plant.sensors import InertialSensors, PositionSensor, add_noise, sensor_generator
from protocol.messages import FloatArray
from protocol.scenario import Noise, World

NOISE = Noise(position=0.002, attitude=0.05)
MOTION = np.array([1.0, -2.0, 3.0, 0.4, -0.3, 1.2, 0.1, 0.2, 0.3, 4.0, -5.0, 6.0])
EARTH_RADIUS_KM = 6371.0

modest = settings(deadline=None, max_examples=50)


def test_the_noise_is_gaussian_with_the_scenarios_deviations() -> None:
    count = 20_000
    normal = PositionSensor(5).draw(count)
    # Five standard errors: of a mean 1/sqrt(n), of a deviation 1/sqrt(2n), of a correlation 1/sqrt(n).
    assert np.abs(normal.mean(axis=0)).max() < 5.0 / math.sqrt(count)
    assert np.abs(normal.std(axis=0) - 1.0).max() < 5.0 / math.sqrt(2 * count)
    assert np.abs(np.corrcoef(normal.T) - np.eye(6)).max() < 5.0 / math.sqrt(count)
    assert np.abs(np.mean(normal[1:] * normal[:-1], axis=0)).max() < 5.0 / math.sqrt(count)
    assert np.mean(np.abs(normal) < 1.0) == pytest.approx(math.erf(math.sqrt(0.5)), abs=0.01)


def test_noise_is_the_deviation_of_each_kind_times_the_draw() -> None:
    normal = PositionSensor(5).draw(1)[0]
    measured = np.empty(6)
    add_noise(MOTION, normal, NOISE.position, NOISE.attitude, measured)
    deviation = np.array([NOISE.position] * 3 + [NOISE.attitude] * 3)
    assert measured.tobytes() == (MOTION[:6] + deviation * normal).tobytes()


@modest
@given(st.lists(st.integers(0, 40), max_size=6))
def test_however_the_draws_are_grouped_the_numbers_are_the_same(groups: list[int]) -> None:
    sensor = PositionSensor(2)
    grouped = [sensor.draw(count).tobytes() for count in groups]
    assert b"".join(grouped) == PositionSensor(2).draw(sum(groups)).tobytes()


def test_without_noise_the_sample_is_the_truth() -> None:
    measured = np.empty(6)
    add_noise(MOTION, np.ones(6), 0.0, 0.0, measured)
    assert measured.tobytes() == MOTION[:6].tobytes()


def test_each_sensor_and_each_seed_has_numbers_of_its_own() -> None:
    first = {
        (seed, name): sensor_generator(seed, name).standard_normal(4).tobytes()
        for seed in (0, 1, 2)
        for name in ("position", "imu", "gps")
    }
    assert len(set(first.values())) == len(first)
    assert first[1, "position"] == PositionSensor(1).draw(1)[0, :4].tobytes()


def test_another_sensor_shifts_nobodys_noise() -> None:
    alone = PositionSensor(3).draw(5)
    sensor, other = PositionSensor(3), sensor_generator(3, "imu")
    with_company = []
    for _ in range(5):
        other.standard_normal(17)
        with_company.append(sensor.draw(1))
    assert np.concatenate(with_company).tobytes() == alone.tobytes()


def readings(motion: FloatArray, force: FloatArray, world: World | None = None) -> list[float]:
    return [float(reading) for reading in InertialSensors(world or World()).measure(motion, force)]


def test_the_accelerometer_reads_the_force_that_it_is_given() -> None:
    assert readings(MOTION, np.array([1.0, -2.0, -9.81]))[:3] == [1.0, -2.0, -9.81]


@modest
@given(st.floats(-3.0, 3.0), st.floats(-1.3, 1.3), st.floats(-3.0, 3.0))
def test_rates_and_field_are_those_of_the_turned_body(alpha: float, beta: float, gamma: float) -> None:
    """Against the rotation itself: w is R^BI dR^IB/dt as a vector, the field is R^BI times the field."""
    motion = MOTION.copy()
    motion[3:6] = alpha, beta, gamma
    field = np.array(World().magnetic_field_ned)

    def to_body(q_r: npt.NDArray[Any]) -> npt.NDArray[Any]:
        (sa, sb, sg), (ca, cb, cg) = np.sin(q_r), np.cos(q_r)
        c_b2 = np.array([[1, 0, 0], [0, ca, sa], [0, -sa, ca]])
        c_21 = np.array([[cb, 0, -sb], [0, 1, 0], [sb, 0, cb]])
        product: npt.NDArray[Any] = c_b2 @ c_21 @ np.array([[cg, sg, 0], [-sg, cg, 0], [0, 0, 1]])
        return product

    rotation = to_body(motion[3:6])
    change = (to_body(motion[3:6] + 1e-30j * motion[9:]).imag / 1e-30).T  # dR^IB/dt by a complex step
    spin = rotation @ change
    came = readings(motion, np.zeros(3))
    assert came[3:6] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], rel=1e-12, abs=1e-12)
    assert came[6:9] == pytest.approx((rotation @ field).tolist(), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize(
    ("altitude", "hectopascal"), [(0.0, 1013.25), (1000.0, 898.76), (5000.0, 540.20), (11000.0, 226.32)]
)
def test_the_pressure_is_the_standard_atmospheres(altitude: float, hectopascal: float) -> None:
    """Values of the ICAO standard atmosphere's table."""
    came = readings(np.zeros(12), np.zeros(3), World(altitude=altitude))
    assert came[9] == pytest.approx(hectopascal, rel=3e-4)
    assert came[10:13] == [0.0, altitude, 15.0]


@modest
@given(st.floats(-4000.0, 40_000.0), st.floats(0.1, 1e9))
def test_the_pressure_falls_with_altitude_and_stays_a_number(altitude: float, climb: float) -> None:
    """A diverging flight may climb out of the formula's atmosphere: there is no pressure there, and no complex one."""
    sensors = InertialSensors(World(altitude=altitude))
    low, high = np.zeros(12), np.zeros(12)
    high[2] = -climb
    below, above = sensors.measure(low, np.zeros(3))[9], sensors.measure(high, np.zeros(3))[9]
    assert below > above >= 0.0


@modest
@given(st.floats(-60.0, 60.0), st.floats(-170.0, 170.0), st.floats(-2000.0, 2000.0), st.floats(-2000.0, 2000.0))
def test_the_place_on_the_globe_is_as_far_away_as_the_vehicle(
    latitude: float, longitude: float, north: float, east: float
) -> None:
    """Against the haversine formula; and it lies on the right side."""
    motion = np.zeros(12)
    motion[:3] = north, east, -30.0
    sensors = InertialSensors(World(latitude_deg=latitude, longitude_deg=longitude, altitude=500.0))
    there_latitude, there_longitude, altitude = sensors.geodetic(motion)
    up, across = math.radians(there_latitude - latitude), math.radians(there_longitude - longitude)
    haversine = math.sin(0.5 * up) ** 2 + (
        math.cos(math.radians(latitude)) * math.cos(math.radians(there_latitude)) * math.sin(0.5 * across) ** 2
    )
    distance = 2000.0 * EARTH_RADIUS_KM * math.asin(math.sqrt(haversine))
    assert distance == pytest.approx(math.hypot(north, east), rel=2e-3, abs=1e-5)
    assert altitude == 530.0
    assert up * north >= 0.0
    assert across * east >= 0.0
