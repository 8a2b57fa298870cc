"""`python -m controller`."""

import sys

from bridge.command_line import run_command
from controller.command import controller

if __name__ == "__main__":
    sys.exit(run_command(controller, "controller"))
