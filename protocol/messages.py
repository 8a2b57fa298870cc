"""What the two ends say to each other, free of any wire format.

Axes are always in the order x, y, z, alpha, beta, gamma: position in the inertial frame (north, east, down; m), then
roll, pitch, yaw (rad); generalised forces are body forces (N), then body torques (N m).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import msgspec

if TYPE_CHECKING:  # `--help` needs this module, and is there before numpy would be
    import numpy as np
    import numpy.typing as npt

AXES = ("x", "y", "z", "alpha", "beta", "gamma")
VEHICLE = (1, 1)
"""(system, component) of the controller, as of any autopilot."""
AXIS_UNITS = ("m", "m", "m", "rad", "rad", "rad")

FloatArray: TypeAlias = "npt.NDArray[np.float64]"


class PositionSample(msgspec.Struct, frozen=True, gc=False):
    """What a controller gets to see: where the vehicle is, and when. There is no velocity in it.

    t_ns   simulation time of the sample, ns
    q      (6,) x, y, z (m, north east down), roll, pitch, yaw (rad, each within +-pi)
    """

    t_ns: int
    q: FloatArray


class ActuatorCommand(msgspec.Struct, frozen=True, gc=False):
    """What the motors are told.

    t_ns     time of the sample this command answers, ns (the echo)
    tau      (6,) body force (N) and torque (N m) asked of the motors, before the gears
    armed    whether the motors may act at all
    """

    t_ns: int
    tau: FloatArray
    armed: bool
