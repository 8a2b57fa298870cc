"""The plant emulator: rigid body, gear hysteresis, sensors, safety, and the process that connects them to a link."""
