"""The error tree of the project, and the exit code with which each error ends a command.

    FwavHilError                1
     |- UsageError              2   invalid arguments or options
     |   |- ScenarioError       2   a scenario file: unknown key, wrong type, value out of range
     |- LinkError               3   a link cannot be opened or is gone
     |   |- LinkUriError        2   the URI is not valid
     |   |- LinkInUseError      3   the port or device is in use
     |   |- LinkClosedError     3   the other end closed the link
     |   |- CanBusLostError     3   the CAN interface went bus-off or was lost, and could not be reopened
     |- PeerError               4   the other process
     |   |- PeerMissingError    4   never appeared
     |   |- PeerLostError       4   stopped answering
     |   |- ScenarioMismatchError 4 runs another scenario
     |- DivergenceError         5   the plant left the region where its equations hold
     |- RunFolderError          6   the results cannot be written
     |   |- LogError            6   a log cannot be read
     |- Interrupted           130   the user stopped it

Each message is one sentence that names the place and the remedy; the command line prints it without a traceback. Bad data
received on a link never raises an error: it is counted (see `codec`).
"""

from __future__ import annotations


class FwavHilError(Exception):
    """Base of all errors that a user can cause or see; `exit_code` is the exit code of the command."""

    exit_code = 1


class UsageError(FwavHilError):
    """Invalid arguments of a command or function."""

    exit_code = 2


class ScenarioError(UsageError):
    """A scenario is not valid: the message names the file, the key and the remedy."""


class LinkError(FwavHilError):
    """A link cannot be opened, or broke."""

    exit_code = 3


class LinkUriError(LinkError):
    """A link URI is not valid."""

    exit_code = 2


class LinkInUseError(LinkError):
    """The port or the device is in use by another process."""


class LinkClosedError(LinkError):
    """The other end closed the link (stream transports)."""


class CanBusLostError(LinkError):
    """The CAN interface went bus-off or was lost, and could not be reopened."""


class PeerError(FwavHilError):
    """An error of the process at the other end of the link."""

    exit_code = 4


class PeerMissingError(PeerError):
    """The other end never appeared."""


class PeerLostError(PeerError):
    """The other end stopped answering."""


class ScenarioMismatchError(PeerError):
    """The other end runs another scenario."""


class DivergenceError(FwavHilError):
    """The plant left the region where its equations hold."""

    exit_code = 5


class RunFolderError(FwavHilError):
    """Results cannot be written to their destination."""

    exit_code = 6


class LogError(RunFolderError):
    """A log cannot be read, or the file is not a log."""


class Interrupted(FwavHilError):
    """The user asked the command to stop (Ctrl-C, SIGTERM)."""

    exit_code = 130
