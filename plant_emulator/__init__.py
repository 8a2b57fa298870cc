"""The plant emulator: rigid body, gear hysteresis, sensors, safety, and the process that speaks for them on a link."""
