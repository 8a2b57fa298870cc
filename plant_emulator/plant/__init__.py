"""The plant: rigid body, gears, sensors, safety envelope, ground truth."""
