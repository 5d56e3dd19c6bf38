"""What the subcommands share: their error, the choice of a model, and the checks of what they read and write."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from diffatmo import folders

if TYPE_CHECKING:
    from rich.console import Console

    from diffatmo.atmosphere import Atmosphere
    from diffatmo.models import Model

MODELS = ("moments", "bruneton", "hillaire", "raymarch", "pathtrace")
"""Names of ``diffatmo.models.MODELS``, repeated here because importing that takes seconds; a test compares the two."""


PLAIN_WIDTH = 120
"""Columns of the output where it does not go to a terminal."""

INTERRUPTED = 130
"""Exit status after Ctrl-C, by the convention of shells."""


class InputError(ValueError):
    """Something the user gave is wrong; the message says what, and what would be right."""


def is_refusal(error: BaseException) -> bool:
    """Whether ``error`` refuses what the user gave or reports what the system denied; any other is a fault of ours."""
    if isinstance(error, click.ClickException | OSError):
        return True
    return isinstance(error, ValueError) and type(error).__module__.partition(".")[0] in ("diffatmo", "fitting")


def one_line(error: BaseException) -> str:
    """What is wrong, in one line."""
    if isinstance(error, click.ClickException):
        message = error.format_message()
    elif isinstance(error, OSError) and error.filename is not None:
        message = f"{error.filename}: {error.strerror}"
    else:
        message = str(error)
    return " ".join(message.split())


def printable(name: str | Path) -> str:
    """A file name as text that can be written anywhere: bytes that are no text are shown by their numbers."""
    return str(name).encode("utf-8", errors="backslashreplace").decode()


def make_console(*, quiet: bool = False) -> "Console":
    """The terminal; where the output goes elsewhere, as wide as a table needs."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else PLAIN_WIDTH
    return Console(width=width, highlight=False, markup=False, quiet=quiet)


@contextmanager
def waiting(console: "Console", what: str) -> Iterator[None]:
    """Say what takes its time: beside something that turns in a terminal, elsewhere as a line."""
    if console.is_terminal:
        with console.status(what):
            yield
    else:
        console.print(what, soft_wrap=True)
        yield


def model_options(command: Any) -> Any:
    """Add the options that :func:`make_model` takes."""
    for option in reversed(
        (
            click.option(
                "--model",
                type=click.Choice(MODELS),
                default=MODELS[0],
                show_default=True,
                help="moments: all orders of scattering; bruneton, hillaire: the tables of those papers; raymarch: single "
                "scattering; pathtrace: Monte Carlo.",
            ),
            click.option("--samples", type=click.IntRange(min=32), help="Paths per ray of pathtrace.  [default: 4096]"),
            click.option(
                "--seed", type=click.IntRange(0, 2**32 - 1), help="Of the random numbers of pathtrace.  [default: 0]"
            ),
        )
    ):
        command = option(command)
    return command


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that exist.")


def read_atmosphere(name: str) -> "Atmosphere":
    """The atmosphere in the file ``name``, or the preset of that name."""
    from diffatmo import atmosphere

    if Path(name).exists():
        return atmosphere.load(name)
    if name in atmosphere.PRESETS:
        return atmosphere.PRESETS[name]()
    raise InputError(f"{name}: no such file, and no preset of that name (presets: {', '.join(atmosphere.PRESETS)})")


def check_output(path: Path, *, overwrite: bool) -> None:
    """Refuse an output file that cannot be written or would replace another, before any work is done for it."""
    if path.is_dir():
        raise InputError(f"{path}: is a directory, expected the name of a file to write")
    if not overwrite and path.exists() and path.stat().st_size:
        raise InputError(f"{path}: exists; give --overwrite to replace it")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such directory")
    folders.check_writable(path.parent)


def make_model(name: str, *, samples: int | None = None, seed: int | None = None) -> "Model":
    """The model called ``name``, at its default resolution; ``samples`` and ``seed`` are the path tracer's alone."""
    from diffatmo import models

    chosen = {key: value for key, value in {"samples": samples, "seed": seed}.items() if value is not None}
    if chosen and name != "pathtrace":
        raise InputError(f"--{next(iter(chosen))} contradicts --model {name}: it belongs to pathtrace")
    return models.MODELS[name](**chosen)
