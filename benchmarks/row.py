"""One result of a benchmark: its figure beside its anchor's, and whether it meets its bar."""

from __future__ import annotations

from typing import Any

ALTERNATIONS = 3
"""Machines are shared and noisy: each figure is the best of so many alternations with its anchor."""


def row(
    value: float, unit: str, anchor: str, anchor_value: float, bar: str, *, ok: bool, note: str = ""
) -> dict[str, Any]:
    """A row of results.json; note: what else was seen, for the reader."""
    ratio = value / anchor_value if anchor_value else None
    result = {"value": value, "unit": unit, "anchor": anchor, "anchor_value": anchor_value, "ratio": ratio}
    return {**result, "bar": bar, "ok": ok, **({"note": note} if note else {})}
