"""Compiled programs are kept between runs, so that only the first one waits for the compiler."""

import os
import sys
import tempfile
from pathlib import Path

VARIABLE = "JAX_COMPILATION_CACHE_DIR"
"""Read by JAX when it is imported. A user who has set it, also to nothing, is not overruled."""

SHORTEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
"""From how many seconds on a program is kept: by default one, but a photo needs a hundred small ones, five seconds in all."""


def enable() -> None:
    """Tell JAX where to keep what it compiles; where nothing can be kept, nothing changes.

    JAX files a program under all that it depends on: its code, the version of the compiler, the kind of processor.
    """
    if "jax" in sys.modules:
        return
    os.environ.setdefault(SHORTEST, "0")
    if VARIABLE in os.environ:
        return
    try:
        directory = _caches() / "diffatmo"
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except (OSError, RuntimeError):
        return
    os.environ[VARIABLE] = str(directory)


def _caches() -> Path:
    """The user's folder for caches, by the conventions of the platform."""
    if sys.platform == "win32":
        return Path(os.environ["LOCALAPPDATA"]) if "LOCALAPPDATA" in os.environ else Path.home() / "AppData" / "Local"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
