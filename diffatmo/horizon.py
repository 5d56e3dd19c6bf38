"""A straight horizon in a photograph: where the sky meets the sea or a plain."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from diffatmo.features import Features, Small, blurred, checked, factor_of, features, light_of

STEEPEST = 0.25
"""Slope of a horizon, in rows per column, up to which one is looked for."""

STRAIGHT = 1 / 400
"""Widths of the picture by which a column may be off a straight horizon."""

REACH = 4
"""Rows on either side of a step."""


class Horizon(NamedTuple):
    """A straight line between sky and sea or plain."""

    row: float
    """Where it crosses the middle of the picture, in rows from the centre of the first."""
    slope: float
    """Rows down per column to the right."""
    confidence: float
    """Share of the columns in which the line is seen, 0 to 1."""

    def rows(self, width: int) -> Float[np.ndarray, " width"]:
        """Row of the line in every column of a picture ``width`` wide."""
        return self.row + self.slope * (np.arange(width) - (width - 1) / 2)


def find_horizon(pixels: Float[np.ndarray, "height width 3"]) -> Horizon | None:
    """The straight line where the sky meets the sea or a plain; None where there is none to be seen."""
    pixels = checked(pixels)
    factor = factor_of(pixels)
    light = light_of(pixels, factor)
    line = horizon_of(features(Small(light, np.zeros(light.shape[:2], dtype=bool), None, None, False)))
    if line is None:
        return None
    return Horizon((line.row + 0.5) * factor - 0.5, line.slope, line.confidence)


def horizon_of(seen: Features) -> Horizon | None:
    """The line across which brightness, colour and texture step in the same way in most of the columns."""
    height, width = seen.lit.shape
    if height < 8 * REACH or width < 8 * REACH:
        return None
    steps = np.stack([_steps(seen.luminance), _steps(seen.ratio), _steps(np.log(np.maximum(seen.roughness, 0.02))) / 4])
    # Steps are held to be 1 at most, so that a few strong ones do not decide.
    column = np.arange(width)[:: max(1, width // 256)]
    held = np.clip(steps[..., column] / 0.2, -1, 1)
    x = column - (width - 1) / 2
    best, line = 0.0, (0.0, 0.0)
    for slope in np.linspace(-STEEPEST, STEEPEST, 101):
        rows = np.round(np.arange(height)[:, None] + slope * x).astype(int)
        inside = (rows >= 3 * REACH) & (rows <= height - 3 * REACH)
        along = np.where(inside, held[:, np.clip(rows, 0, height - 1), np.arange(column.size)], 0).mean(axis=-1)
        strength = np.linalg.norm(along, axis=0)
        if strength.max() > best:
            best, line = float(strength.max()), (float(strength.argmax()), float(slope))
    return _refined(steps, line) if best > 0.5 else None


def _refined(steps: np.ndarray, line: tuple[float, float]) -> Horizon | None:
    """A line through the strongest step near ``line`` in each column; None if it is seen in less than half of them."""
    height, width = steps.shape[1:]
    column = np.arange(width)
    x = column - (width - 1) / 2
    size = np.linalg.norm(steps, axis=0)
    rows = np.round(line[0] + line[1] * x).astype(int)[None, :] + np.arange(-2 * REACH, 2 * REACH + 1)[:, None]
    inside = (rows >= 3 * REACH) & (rows <= height - 3 * REACH)
    near = np.where(inside, size[np.clip(rows, 0, height - 1), column], 0)
    strong = near.max(axis=0) > 0.15
    y = rows[near.argmax(axis=0), column].astype(float)
    row, slope = line
    for tolerance in (2.0 * REACH, REACH, REACH / 2):
        kept = strong & (np.abs(y - row - slope * x) <= tolerance)
        if kept.sum() < 0.5 * width:
            return None
        row, slope = np.polynomial.polynomial.polyfit(x[kept], y[kept], 1)
    # A step lies between its row and the one above.
    kept = strong & (np.abs(y - row - slope * x) <= STRAIGHT * width)
    return Horizon(float(row) - 0.5, float(slope), float(kept.mean())) if kept.sum() >= 0.5 * width else None


def _steps(image: np.ndarray) -> np.ndarray:
    """Mean of the rows from each on, less that of the rows before it."""
    height = image.shape[0]
    sums = np.cumsum(np.pad(blurred(image, 1.0), ((1, 0), (0, 0))), axis=0, dtype=np.float64)
    means = (sums[REACH:] - sums[:-REACH]) / REACH
    steps = np.zeros(image.shape, dtype=np.float32)
    steps[REACH : height - REACH + 1] = means[REACH:] - means[:-REACH]
    # A step is sharp: what goes on in the same way above and below is the slope of a smooth sky.
    around = np.pad(steps, ((2 * REACH, 2 * REACH), (0, 0)), mode="edge")
    return steps - (around[: -4 * REACH] + around[4 * REACH :]) / 2
