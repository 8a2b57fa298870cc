"""Sources and a cache of their own."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from tests.protocol.source_tree import make_tree


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache and the system's temporary place, both within tmp_path."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path


@pytest.fixture
def tree(places: Path) -> Path:
    """A project with one source in each package, and copies of the modules that keep kernels."""
    return make_tree(places / "tree")
