# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The typer application, and the one place where errors are printed."""

from __future__ import annotations

import errno
import inspect
import io
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated, Any, TypeVar

import typer

from radarsdf.cli.commands import COMMANDS

app = typer.Typer(
    name="radarsdf",
    help="From 3D radar scans to a surface and a reflectance map, on a CPU.",
    context_settings={"help_option_names": ["-h", "--help"]},
)

_Command = TypeVar("_Command", bound=Callable[..., int | None])
_MODULES = ("scans", "fits", "maps", "pages", "tiles")
_ERRORS = (ValueError, OSError, ImportError, FloatingPointError, MemoryError)
"""Errors with a message for the user. Every other error is a bug and keeps its traceback."""

_SHARED_HELP = {
    "map_path": "The map: .safetensors of radarsdf fit, or the folder of radarsdf tiles.",
    "box": "Use only the part between these two corners: lower, upper, world frame, m.",
    "holdout": "Compare intensities with the scans that radarsdf fit --holdout N left out.",
    "geometry_only": "Do not use the intensities.",
    "no_check": "Do not refuse scans in which radarsdf check would find an error.",
    "refine": "Refine the poses by the returns first.",
    "quiet": "Show no progress bar.",
}
_METAVARS = {
    "box": "X0 Y0 Z0 X1 Y1 Z1",
    "viewpoint": "X Y Z",
    "pose": "P",
    "heights": "LOW HIGH",
    "set": "NAME=VALUE",
    "field": "ROLE=NAME",
    "topic": "NAME",
    "tile": "NAME",
}


class UsageError(typer.TyperException):
    """The command line is wrong: exit status 2."""

    exit_code = 2


def refuse_if(wrong: object, message: str) -> None:
    """Raise a :class:`UsageError` of this message if something is wrong."""
    if wrong:
        raise UsageError(message)


def warn(text: str) -> None:
    """Print a line on standard error."""
    typer.echo(text, err=True)


def run(words: Sequence[str]) -> int:
    """Run the command of these words, print its error, and return the exit status."""
    # A character that a terminal lacks must not cost the work before it.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    for module in _MODULES:
        import_module(f"radarsdf.cli.{module}")
    try:
        status = app(list(words), prog_name="radarsdf", standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        where = f"; {context.command_path} --help lists the options" if context else ""
        warn(f"error: {error.format_message().rstrip('.')}{where}")
        return error.exit_code
    except SystemExit as end:  # of a pipe whose reader has gone
        return int(end.code or 0)
    return int(status or 0)


def command(group: typer.Typer = app, **settings: Any) -> Callable[[_Command], _Command]:
    """Register a function as a command with its arguments and options, which its signature and docstring describe.

    Positional parameters are arguments, the others options, and a line ``name: text`` of the docstring is the help of one.
    A parameter whose annotation is a dataclass stands for its fields, so that commands share options; a :class:`Results`
    for ``--json``.
    """

    def register(function: _Command) -> _Command:
        groups: dict[str, tuple[type, list[str]]] = {}
        parameters: list[inspect.Parameter] = []
        texts, name = _SHARED_HELP | _texts(function), function.__name__.strip("_")
        for parameter in inspect.signature(function, eval_str=True).parameters.values():
            kind: Any = parameter.annotation
            fields, panel = [parameter], None
            if hasattr(kind, "__dataclass_fields__"):
                fields = list(inspect.signature(kind, eval_str=True).parameters.values())
                groups[parameter.name] = (kind, [field.name for field in fields])
                texts, panel = _texts(kind) | texts, getattr(kind, "panel", None)
            parameters += [_as_typer_has_it(field, texts[field.name], panel) for field in fields]

        def call(**values: Any) -> int | None:
            with _errors_printed():
                for group_name, (kind, fields) in groups.items():
                    values[group_name] = kind(**{field: values.pop(field) for field in fields})
                status = function(**values)
                if results := values.get("results"):
                    results.end()
                return status

        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        if group is app:
            ((panel, text),) = [(panel, of[name]) for panel, of in COMMANDS.items() if name in of]
            settings.update(help=text, rich_help_panel=panel)
        else:
            settings["help"] = (function.__doc__ or "").splitlines()[0]
        group.command(name, **settings)(call)
        return function

    return register


def _texts(documented: Any) -> dict[str, str]:
    """The lines ``name: text`` of a docstring, whose texts may go on in indented lines."""
    paragraphs = re.findall(r"^(\w+): (.+(?:\n +.+)*)", inspect.getdoc(documented) or "", re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in paragraphs}


def _as_typer_has_it(parameter: inspect.Parameter, text: str, panel: str | None) -> inspect.Parameter:
    option = f"--{parameter.name.replace('_', '-')}"
    if parameter.kind is not inspect.Parameter.KEYWORD_ONLY:
        name = parameter.name.removesuffix("_path").upper()
        described: Any = typer.Argument(metavar=name, help=text, show_default=False)
    elif parameter.name == "out":
        described = typer.Option(option, "-o", metavar="PATH", help=text)
    elif "bool" in str(parameter.annotation) and parameter.default is not False:
        described = typer.Option(f"{option}/--no-{option[2:]}", help=text)
    else:
        metavar = _METAVARS.get(parameter.name)
        described = typer.Option(option, metavar=metavar, help=text, rich_help_panel=panel)
    annotation: Any = Annotated[parameter.annotation, described]
    return parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=annotation)


def _print_version(wanted: bool) -> None:
    if wanted:
        import radarsdf

        typer.echo(f"radarsdf {radarsdf.__version__}")
        raise typer.Exit


@app.callback()
def _main_options(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None: ...


@contextmanager
def _errors_printed() -> Iterator[None]:
    """Errors of a running command become a line on standard error and an exit status."""
    try:
        yield
    except KeyboardInterrupt as stop:  # the status of shells: 128 and the number of the signal
        warn(f"error: {str(stop) or 'interrupted'}")
        raise typer.Exit(130) from stop
    except _ERRORS as error:
        if isinstance(error, OSError) and error.errno == errno.EPIPE:
            raise
        warn(f"error: {message_of(error)}")
        raise typer.Exit(1) from error


def message_of(error: Exception) -> str:
    """An error in one line: of pydantic's, the first wrong setting; of the system's, the file and what is wrong with it."""
    if type(error).__name__ == "ValidationError":  # whose module is imported only with the settings
        from radarsdf.settings import first_wrong

        return first_wrong(error)  # type: ignore[arg-type]
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, OSError) and error.strerror is not None:
        return error.strerror
    # NumPy says which array it could not have; our own words are kept.
    if isinstance(error, MemoryError) and (not str(error) or str(error).startswith("Unable to allocate")):
        return "there is not enough memory"
    return " ".join(str(error).split()) or type(error).__name__
