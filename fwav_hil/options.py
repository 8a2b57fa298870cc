"""The options of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from bridge.options import Except, Option
from bridge.shared_options import DEFAULT_EMULATOR_LINK, EndOptions, folder_option
from controller.options import ControllerOptions
from fwav_hil.placement import Placement
from plant_emulator.options import EmulatorOptions

RunFolder = Annotated[Path | None, folder_option("Folder of the run; by default a new one in runs/.")]


class RunOptions(EndOptions, frozen=True, kw_only=True):
    """The shared options of both ends, and those of each end. All of these are options of `fwav-hil run`, except those left
    out here. Shared options are set here; in `emulator` and `controller` they have no effect.

    show_progress: False where the caller shows its own progress; then no budget line is printed either.
    """

    link: Annotated[str, Option(
        "--link", "The emulator's end of the link: udpin:// or tcpin://; port 0 takes a free one.", "URI"
    )] = DEFAULT_EMULATOR_LINK  # fmt: skip
    emulator: Annotated[
        EmulatorOptions,
        Except(
            "link", "profile", "out",
            station=Option(
                "--emulator-station",
                "A ground station's link to the emulator: the true state and the drives' speed, on request (docs/station.md).",
                "URI",
            ),
        ),
    ] = EmulatorOptions()  # fmt: skip
    controller: Annotated[ControllerOptions, Except("link", "arm", "out")] = ControllerOptions()
    show_progress: bool = True

    def of_ends(self, folder: Path, placement: Placement) -> tuple[EmulatorOptions, ControllerOptions]:
        """The options of the child processes. The controller waits for its link until the emulator has opened its own."""
        shared = {name: getattr(self, name) for name in EndOptions.__struct_fields__}
        shared |= {"spin_s": placement.spin_s, "out": folder}
        return (
            msgspec.structs.replace(self.emulator, **shared, core=placement.emulator),
            msgspec.structs.replace(self.controller, **shared | {"link": "-"}, core=placement.controller),
        )
