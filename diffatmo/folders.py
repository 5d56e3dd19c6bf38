"""Where results go: folders that exist, can be written to, and hold nothing that would be lost."""

import tempfile
from collections.abc import Sequence
from pathlib import Path


class FolderError(ValueError):
    """A folder cannot take results; the message names it and says why."""


def check_writable(directory: Path) -> None:
    """Refuse a folder in which no file can be created."""
    try:
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise FolderError(f"{directory}: cannot be written to: {error.strerror}") from error


def prepare(directory: Path, *, names: Sequence[str], prefixes: Sequence[str] = (), overwrite: bool = False) -> None:
    """Create ``directory`` if need be, and refuse one that holds results of these names, unless they may be replaced."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FolderError(f"{directory}: cannot be written to: {error.strerror}") from error
    check_writable(directory)
    present = sorted(f.name for f in directory.iterdir() if f.name in names or f.name.startswith(tuple(prefixes)))
    if present and not overwrite:
        raise FolderError(f"{directory}: holds results already ({present[0]}); choose another folder, or --overwrite")
