"""Where results go: folders that exist, can be written to, and hold nothing that would be lost."""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

if sys.platform != "win32":
    import fcntl

BLOCK = 4096
"""Bytes that a folder must have room for: on a full disk a file can often be created, but nothing be put into it."""


class FolderError(ValueError):
    """A folder cannot take results; the message names it and says why."""


def check_writable(directory: Path) -> None:
    """Refuse a folder in which no file can be created and filled."""
    try:
        with tempfile.TemporaryFile(dir=directory) as file:
            file.write(bytes(BLOCK))
    except OSError as error:
        raise FolderError(f"{directory}: cannot be written to: {error.strerror}") from error


def check_free(directory: Path, *, names: Sequence[str], prefixes: Sequence[str] = ()) -> None:
    """Refuse a folder that holds results of these names; it need not exist."""
    if not directory.is_dir():
        return
    present = sorted(f.name for f in directory.iterdir() if f.name in names or f.name.startswith(tuple(prefixes)))
    if present:
        raise FolderError(
            f"{directory}: holds results already ({present[0]}); choose another folder, or overwrite them (--overwrite, in "
            "Python overwrite=True)"
        )


def prepare(directory: Path, *, names: Sequence[str], prefixes: Sequence[str] = (), overwrite: bool = False) -> None:
    """Create ``directory`` if need be, and refuse one that holds results of these names, unless they may be replaced."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FolderError(f"{directory}: cannot be written to: {error.strerror}") from error
    check_writable(directory)
    if not overwrite:
        check_free(directory, names=names, prefixes=prefixes)


@contextlib.contextmanager
def claim(directory: Path) -> Iterator[None]:
    """Refuse a folder that another process has claimed. A claim ends with its process, however that ends."""
    if sys.platform == "win32":
        yield
        return
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise FolderError(f"{directory}: another process is writing results there; let it finish or end it") from None
    except OSError:
        # A file system without locks: no protection, but no obstacle either.
        pass
    try:
        yield
    finally:
        os.close(descriptor)


def sweep(directory: Path) -> None:
    """Remove what a process that was killed while it wrote has left. Only where no other process writes."""
    with contextlib.suppress(OSError):
        for file in directory.glob(".*.part"):
            file.unlink()
