# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The typer application, and the one place where errors are printed."""

from __future__ import annotations

import errno
import inspect
import io
import re
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from radarsdf.cli.commands import COMMANDS, TILE_STEPS

_ERRORS = (ValueError, OSError, ImportError, FloatingPointError, MemoryError)
"""Errors with a message for the user. Every other error is a bug and keeps its traceback."""

_SHARED_HELP = {
    "map_path": "The map: .safetensors of radarsdf fit, or the folder of radarsdf tiles.",
    "box": "Use only the part between these two corners: lower, upper, world frame, m.",
    "holdout": "Compare intensities with the scans that radarsdf fit --holdout N left out.",
    "geometry_only": "Do not use the intensities.",
    "no_check": "Do not refuse scans in which radarsdf check would find an error.",
    "refine": "Refine the poses by the returns first.",
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
# Help in plain text, as in most tools: typer's panels take rich, whose import doubles the time of --help.
_STYLE: dict[str, Any] = {
    "context_settings": {"help_option_names": ["-h", "--help"]},
    "rich_markup_mode": None,
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
    words = _in_full(list(words))
    try:
        status = _application(words[0] if words else "")(words, prog_name="radarsdf", standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        where = f"; {context.command_path} --help lists the options" if context else ""
        text = error.format_message().rstrip(".").replace("Value error, ", "")
        warn(f"error: {text}{where}")
        return error.exit_code
    except SystemExit as end:  # of a pipe whose reader has gone
        return int(end.code or 0)
    return int(status or 0)


def _in_full(words: list[str]) -> list[str]:
    """Words as typer takes them: ``tiles SCANS`` is ``tiles run SCANS``, ``--pose 5 0 1.5`` is ``--pose "5 0 1.5"``."""
    if words == ["tiles"]:
        return ["tiles", "--help"]
    if words[:1] == ["tiles"] and words[1] not in (*TILE_STEPS, "--help", "-h"):
        words = ["tiles", "run", *words[1:]]
    found: list[str] = []
    in_pose = False
    for word in words:
        if in_pose and (found[-1] == "--pose" or is_number(word)):
            found += [word] if found[-1] == "--pose" else [f"{found.pop()} {word}"]
        else:
            found.append(word)
            in_pose = word == "--pose"
    return found


def is_number(word: str) -> bool:
    """Whether a word can be read as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _application(first_word: str) -> typer.Typer:
    """The application with the command that the first word names alone, or with all of them.

    So its help imports no module of another, and no pydantic, which typer takes for options of the application itself.
    """
    commands = {name: found for of_heading in COMMANDS.values() for name, found in of_heading.items()}
    named = {first_word: commands[first_word]} if first_word in commands else commands
    several = named is commands
    app = typer.Typer(add_completion=several, add_help_option=several, **_STYLE)
    app.callback()(_main_options)
    for name, (path, text) in named.items():
        module, _, function = path.partition(".")
        found = import_module(f"radarsdf.cli.{module}")
        if function:
            app.command(name, help=text)(_for_typer(getattr(found, function)))
            continue
        steps = typer.Typer(subcommand_metavar="[STEP] [ARGS]...", **_STYLE)
        app.add_typer(steps, name=name, help=text)
        for step, step_text in TILE_STEPS.items():
            steps.command(step, help=step_text)(_for_typer(getattr(found, step)))
    return app


def _for_typer(function: Callable[..., int | None]) -> Callable[..., int | None]:
    """The function with a signature that typer reads, and its errors printed.

    Positional parameters are arguments, the others options, and a line ``name: text`` of the docstring is the help of one.
    A parameter whose annotation is a dataclass stands for its fields, so that commands share options.
    """
    own: list[inspect.Parameter] = []
    shared: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    texts = dict(_SHARED_HELP)
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        kind: Any = parameter.annotation
        if hasattr(kind, "__dataclass_fields__"):
            fields = list(inspect.signature(kind, eval_str=True).parameters.values())
            groups[parameter.name] = (kind, [field.name for field in fields])
            texts |= _texts(kind)
            shared += fields
        else:
            own.append(parameter)
    texts |= _texts(function)
    parameters = [
        _as_typer_has_it(parameter, texts[parameter.name])
        for parameter in sorted(own + shared, key=lambda each: each.kind is inspect.Parameter.KEYWORD_ONLY)
    ]

    def call(**values: Any) -> int | None:
        try:
            for name, (kind, fields) in groups.items():
                values[name] = kind(**{field: values.pop(field) for field in fields})
            status = function(**values)
            if results := values.get("results"):
                results.end()
        except KeyboardInterrupt as stop:  # the status of shells: 128 and the number of the signal
            warn(f"error: {str(stop) or 'interrupted'}")
            return 130
        except _ERRORS as error:
            if isinstance(error, OSError) and error.errno == errno.EPIPE:
                raise
            warn(f"error: {message_of(error)}")
            return 1
        return status

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


def _texts(documented: Any) -> dict[str, str]:
    """The lines ``name: text`` of a docstring, whose texts may go on in indented lines."""
    paragraphs = re.findall(r"^(\w+): (.+(?:\n +.+)*)", inspect.getdoc(documented) or "", re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in paragraphs}


def _as_typer_has_it(parameter: inspect.Parameter, text: str) -> inspect.Parameter:
    option = f"--{parameter.name.replace('_', '-')}"
    if parameter.kind is not inspect.Parameter.KEYWORD_ONLY:
        name = parameter.name.removesuffix("_path").upper()
        described: Any = typer.Argument(metavar=name, help=text, show_default=False)
    elif parameter.name == "out":
        described = typer.Option(option, "-o", metavar="PATH", help=text)
    elif "bool" in str(parameter.annotation) and parameter.default is not False:
        described = typer.Option(f"{option}/--no-{option[2:]}", help=text)
    else:
        described = typer.Option(option, metavar=_METAVARS.get(parameter.name), help=text)
    annotation: Any = Annotated[parameter.annotation, described]
    return parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=annotation)


def _print_version(wanted: bool) -> None:
    if wanted:
        import radarsdf

        typer.echo(f"radarsdf {radarsdf.__version__}")
        raise typer.Exit


def _main_options(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None: ...


def message_of(error: Exception) -> str:
    """An error in one line: of pydantic's, the first wrong setting; of the system's, the file and what is wrong with it."""
    if type(error).__name__ == "ValidationError":  # whose module is imported only with the settings
        from radarsdf.settings import first_wrong

        return first_wrong(error)  # type: ignore[arg-type]
    if isinstance(error, OSError) and error.strerror is not None:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    # NumPy says which array it could not have; our own words are kept.
    if isinstance(error, MemoryError) and (not str(error) or str(error).startswith("Unable to allocate")):
        return "there is not enough memory"
    return " ".join(str(error).split()) or type(error).__name__
