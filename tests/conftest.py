"""Settings of the whole suite."""

from __future__ import annotations

import pytest
from hypothesis import settings

# A slow minute of a shared machine is no failure: no deadlines.
settings.register_profile("fwav-hil", deadline=None, print_blob=True)
settings.load_profile("fwav-hil")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="Make the golden logs in tests/golden anew instead of comparing."
    )
