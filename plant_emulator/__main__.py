"""`python -m plant_emulator`."""

import sys

from bridge.command_line import run_command
from plant_emulator.command import emulator

if __name__ == "__main__":
    sys.exit(run_command(emulator, "plant_emulator"))
