"""What images determine together though not alone, in words.

Two numbers a and b whose errors are strongly correlated are known better in a combination a b^p: its relative variance
var(ln a) + 2 p cov + p² var(ln b) is least for p = -cov / var(ln b). For a coefficient and its scale height, p is near 1:
their product is the optical depth. A power is rounded to a half where that costs little, as β H says more than β H^0.93.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.findings import Estimate

GAIN = 3.0
"""How much better than either of its numbers a combination has to be known to be worth a word."""

LOOSE = 0.01
"""Relative error below which a number alone is known well enough not to be worth one."""

TIED = 0.99999
"""Correlation of numbers that are multiples of each other."""


class Combination(NamedTuple):
    """``first`` times ``second`` to the ``power``, and the relative standard errors of it and of both alone."""

    first: str
    second: str
    power: float
    error: float
    alone: tuple[float, float]

    @property
    def text(self) -> str:
        """In words."""
        power = "" if self.power == 1 else f"^{self.power:g}"
        own = " and ".join(_percent(error) for error in self.alone)
        return f"{self.first} × {self.second}{power} to {_percent(self.error)} (alone to {own})"


def _percent(error: float) -> str:
    return f"{100 * error:.2g} %"


def combinations(covariance: Float[np.ndarray, "q q"], estimates: Sequence[Estimate]) -> list[Combination]:
    """The combinations of two fitted numbers worth telling, that of the greatest gain first.

    ``covariance`` is that of ``estimates``, in order. Wavelengths of one field are not combined with each other.
    """
    known = [
        number
        for number, estimate in enumerate(estimates)
        if estimate.standard_error and estimate.value and not estimate.derived and not estimate.at_bound
    ]
    # Of numbers of a field that are multiples of each other, the first stands for all.
    known = [j for j in known if not any(_tied(covariance, estimates, i, j) for i in known if i < j)]
    pairs = [(i, j) for i in known for j in known if i < j and estimates[i].field != estimates[j].field]
    found = [pair for i, j in pairs if (pair := _combined(covariance, estimates, i, j)) is not None]
    found.sort(key=lambda pair: pair.error / min(pair.alone))
    told: set[str] = set()
    result = []
    for pair in found:
        # Each says something of a number that was not mentioned before.
        if not {pair.first, pair.second} <= told:
            result.append(pair)
            told |= {pair.first, pair.second}
    return result


def _tied(covariance: Float[np.ndarray, "q q"], estimates: Sequence[Estimate], i: int, j: int) -> bool:
    """Whether two numbers of one field are one."""
    together = abs(covariance[i, j]) > TIED * math.sqrt(covariance[i, i] * covariance[j, j])
    return estimates[i].field == estimates[j].field and together


def _combined(
    covariance: Float[np.ndarray, "q q"], estimates: Sequence[Estimate], i: int, j: int
) -> Combination | None:
    """The best combination of two numbers, if it is worth telling."""
    values = np.array([estimates[i].value, estimates[j].value])
    relative = covariance[np.ix_([i, j], [i, j])] / np.outer(values, values)
    alone = math.sqrt(relative[0, 0]), math.sqrt(relative[1, 1])
    if min(alone) < LOOSE or abs(relative[0, 1]) > TIED * alone[0] * alone[1]:
        return None
    names = estimates[i].name, estimates[j].name
    if alone[0] > math.sqrt(2) * alone[1]:
        # The power is that of the less certain number, and at most about one.
        relative, alone, names = relative[::-1, ::-1], alone[::-1], names[::-1]
    best = -relative[0, 1] / relative[1, 1]
    half = round(2 * best) / 2
    power = half if half and _error(relative, half) < 1.5 * _error(relative, best) else round(best, 2)
    error = _error(relative, power)
    return Combination(*names, power, error, alone) if error * GAIN < min(alone) else None


def _error(relative: Float[np.ndarray, "2 2"], power: float) -> float:
    vector = np.array([1, power])
    return math.sqrt(max(float(vector @ relative @ vector), 0.0))
