"""Names that users write."""

import difflib
from collections.abc import Sequence


def did_you_mean(name: object, known: Sequence[str]) -> str:
    """The end of a sentence about a ``name`` that is none of ``known``; empty if none is like it."""
    close = difflib.get_close_matches(str(name), known, n=1)
    return f", did you mean {close[0]!r}?" if close else ""
