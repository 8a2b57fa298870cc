"""Command-line options, each declared once: at the structure field, or the command parameter, that it fills.

    class ControllerOptions(msgspec.Struct, frozen=True, kw_only=True):
        wait_s: Annotated[float, Option("--wait", "How long to wait for the other end to appear.", "S", min=0.1)] = 30.0

    @command("controller", "fwav-hil controller flapper --wait 5")
    def controller(options: ControllerOptions, json_path: JsonPath = None) -> None: ...

`command` makes the click command. A parameter whose type is a structure stands for the options of all its fields, nested
structures included, and the function receives the filled structure. A field without an `Option` keeps its default.
"""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import click
import msgspec

from bridge.option_types import FiniteRange
from protocol.errors import UsageError

_REQUIRED = msgspec.NODEFAULT
_Given = Mapping[str, Any]
"""Values that click read, by the name of the click parameter."""


@dataclass(frozen=True)
class Option:
    """How a value is given on a command line. The value's type sets the rest: a `Literal` gives choices, a tuple may repeat.

    flag       "--wait", or "--plots/--no-plots" for a bool that is true by default
    metavar    placeholder of the value in the help
    min, max   bounds of a number; min_open: `min` itself is excluded
    type       click type, where the text of a value differs from its Python type
    only_with  another option that this one requires: "--into", or with its value: "--motor can"
    """

    flag: str
    help: str
    metavar: str | None = None
    _: KW_ONLY
    min: float | None = None
    max: float | None = None
    min_open: bool = False
    type: click.ParamType[Any] | None = None
    only_with: str = ""


@dataclass(frozen=True)
class Argument:
    """A positional value on the command line; a tuple takes all remaining ones."""

    metavar: str | None = None
    _: KW_ONLY
    type: click.ParamType[Any] | None = None


class Except:
    """Fields of a structure that a command does not offer, or offers with another option."""

    def __init__(self, *left_out: str, **changed: Option) -> None:
        self.marks: dict[str, Option | None] = {**dict.fromkeys(left_out), **changed}


def command(
    name: str, *examples: str, group: click.Group | None = None
) -> Callable[[Callable[..., Any]], click.Command]:
    """Make a command from a function; its help is the docstring and the examples. It is added to `group`, if given.

    Raises TypeError where one flag is declared in two different ways, or `Except` names an unknown field.
    """

    def make(function: Callable[..., Any]) -> click.Command:
        options = _Options()
        hints = get_type_hints(function, include_extras=True)
        readers = {}
        for parameter in inspect.signature(function).parameters.values():
            default = _REQUIRED if parameter.default is parameter.empty else parameter.default
            readers[parameter.name] = options.reader(parameter.name, hints[parameter.name], default)

        def callback(**given: Any) -> Any:
            options.check(given)
            return function(**{name: read(given) for name, read in readers.items() if read})

        made = click.Command(
            name,
            params=list(options.parameters.values()),
            callback=callback,
            help=inspect.cleandoc(function.__doc__ or ""),
            epilog="\n  ".join(("\b\nExample:", *examples)),
        )
        if group:
            group.add_command(made)
        return made

    return make


class _Options:
    """The click parameters of one command, by flag or argument name, and how to read their values."""

    def __init__(self) -> None:
        self.parameters: dict[str, click.Parameter] = {}
        self._declared: dict[str, tuple[Option, Any]] = {}

    def reader(
        self, name: str, kind: Any, default: Any, changed: Option | None = None
    ) -> Callable[[_Given], Any] | None:
        """A function that reads the value of a parameter or field from click's values; None where no option fills it."""
        marks = getattr(kind, "__metadata__", ())
        kind = get_args(kind)[0] if marks else kind
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            but = next((mark.marks for mark in marks if isinstance(mark, Except)), {})
            return self._structure_reader(kind, kind() if default is _REQUIRED else default, but)
        mark = changed or next((mark for mark in marks if isinstance(mark, Option | Argument)), None)
        if mark is None:
            return None
        if isinstance(mark, Option):
            parameter = self._option(mark, kind, default)
        else:
            parameter = self.parameters[name] = _argument(mark, name, kind, default)
        return lambda given: given[parameter.name or name]

    def _structure_reader(
        self, kind: type[msgspec.Struct], default: Any, but: Mapping[str, Option | None]
    ) -> Callable[[_Given], Any]:
        fields = {field.name: field.type for field in msgspec.structs.fields(kind)}
        if unknown := but.keys() - fields.keys():
            raise TypeError(f"{kind.__name__} has no field {', '.join(unknown)}")
        readers = {
            name: read
            for name, of_field in fields.items()
            if but.get(name, _REQUIRED) is not None
            and (read := self.reader(name, of_field, getattr(default, name), but.get(name)))
        }
        return lambda given: msgspec.structs.replace(default, **{name: read(given) for name, read in readers.items()})

    def _option(self, mark: Option, kind: Any, default: Any) -> click.Parameter:
        flag = mark.flag.partition("/")[0]
        if self._declared.setdefault(flag, (mark, default)) != (mark, default):
            raise TypeError(f"{flag} is declared twice, in different ways")
        if flag not in self.parameters:
            kind, several = _element(kind)
            attributes: dict[str, Any] = {"required": True} if default is _REQUIRED else {"default": default}
            if kind is bool:
                attributes |= {"is_flag": True}
            else:
                attributes |= {"type": mark.type or _type_of(kind, mark), "multiple": several}
            shown = bool(default) and default is not _REQUIRED
            self.parameters[flag] = click.Option(
                [mark.flag], show_default=shown, metavar=mark.metavar, help=mark.help, **attributes
            )
        return self.parameters[flag]

    def check(self, given: _Given) -> None:
        """Raise UsageError where an option was given without the other option that it requires."""
        for flag in given_options():
            needed = self._declared[flag][0].only_with if flag in self._declared else ""
            other, _, value = needed.partition(" ")
            if other in self.parameters:
                there = given[self.parameters[other].name or ""]
                if there != value if value else not there:
                    raise UsageError(f"{flag} has no effect without {needed}: add it, or leave {flag} out")


def given_options() -> list[str]:
    """What was given to the running command: options by their (first) flag, arguments by their name in capitals."""
    context = click.get_current_context()
    return [
        parameter.opts[0] if parameter.param_type_name == "option" else parameter.human_readable_name
        for parameter in context.command.params
        if context.get_parameter_source(parameter.name or "") is not click.core.ParameterSource.DEFAULT
    ]


def _argument(mark: Argument, name: str, kind: Any, default: Any) -> click.Argument:
    kind, several = _element(kind)
    attributes = {"required": True} if default is _REQUIRED else {"default": default}
    of_value = mark.type or _type_of(kind, Option("", ""))
    return click.Argument([name], type=of_value, nargs=-1 if several else 1, metavar=mark.metavar, **attributes)


def _element(kind: Any) -> tuple[Any, bool]:
    """The type of one value, without None (of a tuple: that of its elements), and whether it was a tuple."""
    if get_origin(kind) in (Union, types.UnionType):
        (kind,) = (one for one in get_args(kind) if one is not types.NoneType)
    return (get_args(kind)[0], True) if get_origin(kind) is tuple else (kind, False)


def _type_of(kind: Any, mark: Option) -> click.ParamType[Any]:
    if get_origin(kind) is Literal:
        return click.Choice(get_args(kind))
    if kind is Path:
        return click.Path(path_type=Path)
    low, high = mark.min, mark.max
    if low is None and high is None:
        return cast("click.ParamType[Any]", {float: click.FLOAT, int: click.INT, str: click.STRING}[kind])
    if kind is float:
        return FiniteRange(min=low, max=high, min_open=mark.min_open)
    return click.IntRange(None if low is None else int(low), None if high is None else int(high))
