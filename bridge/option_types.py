"""Types of command line options beyond those of click."""

from __future__ import annotations

import math
from typing import Any

import click


class FiniteRange(click.FloatRange):
    """A `FloatRange` that takes numbers only: click's own lets `nan` pass, and `inf` where there is no upper end."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number, or fail with the sentence that names the remedy."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is no number to reckon with: write one such as 0.5 or 20", param, ctx)
        return number
