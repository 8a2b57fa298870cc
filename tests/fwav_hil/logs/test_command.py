"""Every command of `fwav-hil log` says what it does."""

from __future__ import annotations

import pytest

from fwav_hil.logs.command import log_group
from tests.fwav_hil.logs.conftest import Shell


@pytest.mark.parametrize("name", log_group.commands)
def test_every_command_has_help_with_an_example(shell: Shell, name: str) -> None:
    ended = shell(name, "--help")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.partition("Example:\n")[2].strip().startswith(f"fwav-hil log {name} ")
