"""The option `--dialect` of whatever reads a MAVLink log. Giving it chooses the dialect; its value is not needed again."""

from __future__ import annotations

from typing import Annotated, Any

import click

from bridge.options import Option


class DialectName(click.ParamType[str]):
    """A dialect of pymavlink's, or a file of definitions: logs are read with it until the command has ended."""

    name = "dialect"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name, once its messages are there. Raises UsageError where it names none."""
        from protocol.logs.dialect import choose

        choose(value)
        if ctx:
            ctx.call_on_close(lambda: choose(None))
        return str(value)


Dialect = Annotated[str | None, Option(
    "--dialect",
    "The messages of a MAVLink log: a dialect of pymavlink's, or a file of definitions. Default: all that pymavlink has.",
    "NAME|FILE.xml",
    type=DialectName(),
)]  # fmt: skip
