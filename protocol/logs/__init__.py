"""Telemetry logs: writing, reading, changing."""
