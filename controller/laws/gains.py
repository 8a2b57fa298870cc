"""How a law declares its gains: a struct with a field for each, which says what the gain is called on the link.

    class MyGains(Table, frozen=True):
        stiffness: Annotated[Positive6, LinkParameter("MY_STIFF", "stiffness, 1/s^2")] = (40.0,) * 6

A field is one number, or six, one for each axis; types and ranges are those of `protocol.scenario`. A default is what flies a
scenario that says nothing of this law.
"""

from __future__ import annotations

from typing import NamedTuple


class LinkParameter(NamedTuple):
    """A gain as a MAVLink parameter.

    prefix: its name, of 16 characters at most with `_PITCH` behind it where it has six. meaning: with its unit. settable:
    whether a ground station may set it while disarmed; not where another value is a law of another form.
    """

    prefix: str
    meaning: str
    settable: bool = True
