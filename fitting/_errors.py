"""The one error of this package, what it says of names that are not known, and the errors of reading a damaged file."""

import difflib
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from numbers import Real
from typing import Any

import jax
import numpy as np

DAMAGED = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    EOFError,
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What NumPy, zip and JSON raise when a file is not what it seems."""


class FitError(ValueError):
    """A fit was asked for that cannot be done; the message says what is wrong and what would be right."""


def is_number(value: Any) -> bool:
    """Whether ``value`` is one real number: Python's, NumPy's or JAX's."""
    return isinstance(value, Real) or (isinstance(value, np.ndarray | jax.Array) and value.shape == ())


def did_you_mean(name: object, known: Sequence[str]) -> str:
    """The end of a sentence about a ``name`` that is none of ``known``; empty if none is like it."""
    close = difflib.get_close_matches(str(name), known, n=1)
    return f", did you mean {close[0]!r}?" if close else ""
