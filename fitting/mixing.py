"""Where the iterations of a fixed-point map y ← f(y) lead, from the few that were made.

Anderson's mixing (Anderson 1965; Walker & Ni 2011, SIAM J. Numer. Anal. 49, 1715, eq. 1.1): near its fixed point f is about
linear, so the move f(y) - y is smallest at the combination of the places visited whose moves, combined alike, are smallest.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

DEPTH = 3
"""Differences of places that are combined at most."""
LONGEST = 10.0
"""Length of what is added to the last f(y), in units of its move."""
WEAKEST = 1e-3
"""Singular values of the moves' differences, over the largest, that still count."""


def mixed(
    places: Sequence[Float[np.ndarray, " n"]],
    images: Sequence[Float[np.ndarray, " n"]],
    metric: Float[np.ndarray, "k n"],
) -> Float[np.ndarray, " n"]:
    """The next place to visit after ``places``, of which f made ``images``; lengths are those of ``metric`` @ y."""
    last = images[-1]
    visited, led = (np.stack(points[-DEPTH - 1 :]) for points in (places, images))
    moves = (led - visited) @ metric.T
    if len(moves) == 1:
        return last
    along, _, _, _ = np.linalg.lstsq(np.diff(moves, axis=0).T, moves[-1], rcond=WEAKEST)
    step = -np.diff(led, axis=0).T @ along
    length, limit = np.linalg.norm(metric @ step), LONGEST * np.linalg.norm(moves[-1])
    return last + step * (limit / length if length > limit else 1)
