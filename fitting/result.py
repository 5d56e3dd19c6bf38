"""What the user of a fit holds: all that it found."""

from dataclasses import dataclass

from fitting.findings import Findings


@dataclass(frozen=True)
class FitResult(Findings):
    """What a fit found."""
