"""The one error of this package, what it says of names that are not known, and the errors of reading a damaged file."""

import tokenize
import zipfile
import zlib
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
