"""The names of the axes in tables, plots and sentences; JSON keys and file columns keep those of `AXES`."""

from __future__ import annotations

from protocol.messages import AXES

AXIS_NAMES = dict(zip(AXES, ("x", "y", "z", "roll", "pitch", "yaw"), strict=True))
