"""The one error of this package, and those of reading a damaged file."""

import tokenize
import zipfile
import zlib

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
