"""The messages between the two ends, independent of any wire format.

The axes are always in the order x, y, z, roll, pitch, yaw (`AXES` names the angles alpha, beta, gamma, as in the paper):
position in the inertial frame (north, east, down; m), attitude (rad); generalised forces: body force (N), body torque (N m).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import msgspec

if TYPE_CHECKING:  # `--help` needs this module, and should not wait for the import of numpy
    import numpy as np
    import numpy.typing as npt

AXES = ("x", "y", "z", "alpha", "beta", "gamma")
VEHICLE = (1, 1)
"""(system, component) of the controller, as of any autopilot."""
AXIS_UNITS = ("m", "m", "m", "rad", "rad", "rad")

FloatArray: TypeAlias = "npt.NDArray[np.float64]"


class PositionSample(msgspec.Struct, frozen=True, gc=False):
    """A measured pose, the only measurement that a controller gets. It has no velocity.

    t_ns   simulation time of the sample, ns
    q      (6,) x, y, z (m, north east down), roll, pitch, yaw (rad, each within +-pi)
    """

    t_ns: int
    q: FloatArray


class ActuatorCommand(msgspec.Struct, frozen=True, gc=False):
    """The command to the motors.

    t_ns     time of the sample that this command answers, ns (the echo)
    tau      (6,) commanded body force (N) and torque (N m) of the motors, before the gears
    armed    whether the motors may act
    """

    t_ns: int
    tau: FloatArray
    armed: bool
