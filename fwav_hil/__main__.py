"""`python -m fwav_hil`, and the console script."""

from __future__ import annotations

import sys

from bridge.command_line import run_command
from fwav_hil.cli import cli


def main() -> None:
    """Run the command line; ends the process with its exit code."""
    sys.exit(run_command(cli, "fwav-hil"))


if __name__ == "__main__":
    main()
