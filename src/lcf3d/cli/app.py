"""The ``lcf3d`` command: registers the verbs and turns errors into one sentence and exit code 2."""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from typing import Annotated

import typer

from lcf3d.errors import Lcf3dError

# verb -> module of lcf3d.cli that defines a function of that name; heavy imports stay inside the functions
VERBS: dict[str, str] = {
    "demo": "demo",
    "simulate": "simulate",
    "run": "run",
    "live": "live",
    "ros2": "ros2",
    "merge": "merge",
    "export": "export",
    "view": "view",
    "eval": "eval",
    "init": "init",
    "serve": "serve",
    "config": "config",
    "check": "check",
    "bench": "bench",
    "models": "models",
    "calibrate": "calibrate",
    "ablate": "ablate",
    "generalize": "generalize",
    "paper": "paper",
    "submit": "submit",
}
# verbs with verbs of their own: module of lcf3d.cli that defines a typer app of that name
GROUPS: dict[str, str] = {"train": "train"}


def _print_version(wanted: bool) -> None:
    if wanted:
        from lcf3d import __version__

        typer.echo(f"lcf3d {__version__}")
        raise typer.Exit


def _options(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="say what is being done")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and stop")
    ] = False,
) -> None:
    """Late-cascade fusion of camera and LiDAR detections for 3D object detection."""
    from lcf3d.cli.console import start_logging

    start_logging(verbose)


def command(only: str | None = None) -> typer.Typer:
    """The command with all verbs; or with one alone, which spares the imports of all others."""
    made = typer.Typer(
        name="lcf3d",
        help="Late-cascade fusion of camera and LiDAR detections for 3D object detection.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )
    made.callback()(_options)
    for verb, module in VERBS.items():
        if only in (None, verb):
            # what goes on to ROS is not ours to know
            passing = {"ignore_unknown_options": True} if verb == "ros2" else {}
            made.command(verb, context_settings=passing)(getattr(import_module(f"lcf3d.cli.{module}"), verb))
    for group, module in GROUPS.items():
        if only in (None, group):
            made.add_typer(getattr(import_module(f"lcf3d.cli.{module}"), group))
    return made


@cache
def _whole() -> typer.Typer:
    return command()


def __getattr__(name: str) -> typer.Typer:
    """``app``: the command with all verbs, made when it is asked for."""
    if name == "app":
        return _whole()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def main() -> None:
    """Entry point of the ``lcf3d`` command."""
    # options before the verb take no values
    asked = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    try:
        (command(asked) if asked in (*VERBS, *GROUPS) else _whole())()
    except Lcf3dError as error:
        from lcf3d.remote.places import legible

        typer.echo(f"error: {legible(str(error))}", err=True)
        sys.exit(2)
    except OSError as error:
        # no space left, no permission, a folder in the way: the system's own words name the file
        typer.echo(f"error: {error.strerror or error}: {error.filename or ''}".rstrip(": "), err=True)
        sys.exit(2)
