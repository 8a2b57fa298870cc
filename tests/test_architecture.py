"""Rules of the house that no other tool holds."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from protocol.kernel_cache import PACKAGES

ROOT = Path(__file__).resolve().parents[1]
SOURCES = [source for package in PACKAGES for source in sorted((ROOT / package).rglob("*.py"))]
SHADOWED = {"can", "serial", "queue", "types", "signal", "mavlink"}


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: str(source.relative_to(ROOT)))
def test_only_the_clock_asks_for_the_time(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    if source.name != "clock.py":
        assert not re.search(r"^\s*(import time\b|from time import|import datetime|from datetime)", text, re.MULTILINE)


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: str(source.relative_to(ROOT)))
def test_no_file_shadows_a_module_and_none_uses_mavutil(source: Path) -> None:
    assert source.stem not in SHADOWED
    text = source.read_text(encoding="utf-8")
    is_measured_beside_ours = source.name == "mavutil_peer.py"  # a process of its own, which no module imports
    assert is_measured_beside_ours or not re.search(r"import.*\bmavutil\b", text)
    assert not re.search(r"import.*\bmavutil_peer\b", text)
