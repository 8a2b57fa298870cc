"""The one tree of errors of the project, and the exit code each ends a command with.

    FwavHilError                1
     |- UsageError              2   a command was asked for something that makes no sense
     |   |- ScenarioError       2   a scenario file: unknown key, wrong type, value out of range
     |- LinkError               3   a link cannot be opened or is gone
     |   |- LinkUriError        2   the URI is not one
     |   |- LinkInUseError      3   the port or device is taken
     |   |- LinkClosedError     3   the other end closed the link
     |   |- CanBusLostError     3   the CAN interface went bus-off or away, and did not come back
     |- PeerError               4   the other process
     |   |- PeerMissingError    4   never came
     |   |- PeerLostError       4   was there and fell silent
     |   |- ScenarioMismatchError 4 holds another scenario
     |- DivergenceError         5   the plant left the region where its equations hold
     |- RunFolderError          6   the results cannot be written
     |   |- LogError            6   a log cannot be read
     |- Interrupted           130   the user stopped it

The message of each is one sentence that names the place and the remedy; the command line prints it as it is, without a
traceback. Bad data from the wire is never one of these: it is an event that is counted (see `codec`).
"""

from __future__ import annotations


class FwavHilError(Exception):
    """Base of every error that a user can cause or meet; `exit_code` is what a command ends with."""

    exit_code = 1


class UsageError(FwavHilError):
    """A command or function was asked for something that makes no sense."""

    exit_code = 2


class ScenarioError(UsageError):
    """A scenario does not fit: the message names the file, the key and the remedy."""


class LinkError(FwavHilError):
    """A link cannot be opened, or broke."""

    exit_code = 3


class LinkUriError(LinkError):
    """A link URI that names no link."""

    exit_code = 2


class LinkInUseError(LinkError):
    """The port or the device is taken by another process."""


class LinkClosedError(LinkError):
    """The other end closed the link (stream transports)."""


class CanBusLostError(LinkError):
    """The CAN interface went bus-off or away, and did not come back."""


class PeerError(FwavHilError):
    """The process at the other end of the link."""

    exit_code = 4


class PeerMissingError(PeerError):
    """The other end never appeared."""


class PeerLostError(PeerError):
    """The other end was there and fell silent."""


class ScenarioMismatchError(PeerError):
    """The other end holds another scenario."""


class DivergenceError(FwavHilError):
    """The plant left the region in which its equations hold."""

    exit_code = 5


class RunFolderError(FwavHilError):
    """Results cannot be written where they should go."""

    exit_code = 6


class LogError(RunFolderError):
    """A log cannot be read, or is none."""


class Interrupted(FwavHilError):
    """The user asked the command to stop (Ctrl-C, SIGTERM)."""

    exit_code = 130
