"""How a law declares its gains: a struct with a field for each, annotated with the gain's name on the link.

    class MyGains(Table, frozen=True):
        stiffness: Annotated[Positive6, LinkParameter("MY_STIFF", "stiffness, 1/s^2")] = (40.0,) * 6

A field is one number, or six, one for each axis; types and ranges are those of `protocol.scenario`. Defaults apply to a
scenario that does not give the gain.
"""

from __future__ import annotations

from typing import NamedTuple


class LinkParameter(NamedTuple):
    """A gain as a MAVLink parameter.

    prefix: its name; where it has six values, at most 16 characters with `_PITCH` appended. meaning: with its unit. settable:
    whether a ground station may set it while disarmed; False where another value changes the form of the law.
    """

    prefix: str
    meaning: str
    settable: bool = True
