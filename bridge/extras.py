"""Optional libraries by the extra that installs them, and the error message where one is missing."""

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
"""Extra -> names of the modules that it installs; a test compares this with pyproject.toml."""


def remedy(error: ModuleNotFoundError) -> str | None:
    """Message that names the missing library and how to install it; None where no extra has it."""
    module = (error.name or "").partition(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if module in modules), None)
    return extra and f"this needs the library {module}, which is not installed: `pip install 'fwav-hil[{extra}]'`"


def require(*extras: str) -> None:
    """Raise UsageError where a library of these extras is missing; called before a long run that needs it at the end."""
    for module in (module for extra in extras for module in EXTRAS[extra]):
        if importlib.util.find_spec(module) is None:
            raise UsageError(str(remedy(ModuleNotFoundError(name=module))))


@contextlib.contextmanager
def left_out_if_missing(what: str) -> Iterator[None]:
    """Skip the rest of the block where a library of an extra is missing, with a message on standard error."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (sentence := remedy(error)) is None:
            raise
        click.echo(f"no {what}: {sentence}", err=True)
