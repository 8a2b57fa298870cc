"""What is said: messages, streams, MAVLink codec and mapping, the telemetry log format, scenarios, frames and errors.

The lowest package: it imports none of the others, and it is the only one that imports pymavlink.
"""
