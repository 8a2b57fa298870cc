"""The protocol: messages, streams, MAVLink codec and mapping, telemetry logs, scenarios, coordinate frames and errors.

The lowest package: it imports none of the others, and it is the only one that imports pymavlink.
"""
