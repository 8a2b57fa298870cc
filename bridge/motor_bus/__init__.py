"""The CAN bus of the motor drives."""
