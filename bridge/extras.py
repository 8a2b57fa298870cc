"""Libraries that a first run does not need, by the extra that installs them; and what is said where one is missing."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator, Mapping
from types import MappingProxyType

import click

from protocol.errors import UsageError

EXTRAS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "can": ("can", "dronecan"),
        "logs": ("mcap", "pyarrow", "zstandard"),
        "plots": ("matplotlib",),
        "studies": ("hdrh", "scipy"),
    }
)
"""Extra -> the modules that it brings, as they are imported; a test compares this with pyproject.toml."""


def remedy(error: ModuleNotFoundError) -> str | None:
    """What is missing and how to install it; None where no extra has it."""
    module = (error.name or "").partition(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if module in modules), None)
    return extra and f"this needs the library {module}, which is not installed: `pip install 'fwav-hil[{extra}]'`"


def require(*extras: str) -> None:
    """Raise UsageError where a library of these extras is missing: before a long run that would need it at its end."""
    for module in (module for extra in extras for module in EXTRAS[extra]):
        if importlib.util.find_spec(module) is None:
            raise UsageError(str(remedy(ModuleNotFoundError(name=module))))


@contextlib.contextmanager
def left_out_if_missing(what: str) -> Iterator[None]:
    """Leave the rest of the block out where a library of an extra is missing, and say so on standard error."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (sentence := remedy(error)) is None:
            raise
        click.echo(f"no {what}: {sentence}", err=True)
