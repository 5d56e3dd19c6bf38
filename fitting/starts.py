"""Where else a search could begin: a coarse grid about the given start, held against the images.

From a start that is wrong by a factor of ten in the optical depth of the aerosol, the first steps of Levenberg-Marquardt may
lead to an atmosphere of a thousand kilometres, where no derivative leads back. So the numbers that a start may have wrong are
tried at three values each: the aerosol's coefficients at a fifth and five times the start, scale heights at half and twice,
g 0.3 below and above. A grid of at most 81 atmospheres, of which a few hundred pixels are computed in one compiled program.

They are ranked by how far ln(expected / measured) is off, in units of the noise: unlike χ² it does not favour atmospheres that
are too dark, where no pixel can be off by more than its whole signal. Its mean is that of the absolute values, of which clouds
take no possession, and exposures are set for each atmosphere.

Two minima are *distinct* if they are more than :data:`APART` standard errors apart by the linear model at either, and the worse
one counts as long as its χ² is less than :data:`RIVAL` times that of the best.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffatmo.compiling import outermost
from diffatmo.numerics import array
from fitting.batch import Batch
from fitting.elimination import starting
from fitting.parameters import Aerosol, Block, Coordinates, Parameters, Single
from fitting.problem import Predicted, Problem, predict

FACTORS: dict[str, float] = {
    "mie_scattering": 5.0,
    "mie_absorption": 5.0,
    "rayleigh_scale_height": 2.0,
    "mie_scale_height": 2.0,
}
"""By what a start may be wrong."""

ASYMMETRY = 0.3
"""By how much g may be."""

LARGEST_ASYMMETRY = 0.95

AXES: tuple[tuple[str, ...], ...] = (
    ("mie_scattering", "mie_absorption"),
    ("rayleigh_scale_height",),
    ("mie_scale_height",),
    ("mie_g",),
)
"""What changes together."""

OF_HEIGHT = {
    "rayleigh_scattering": "rayleigh_scale_height",
    "mie_scattering": "mie_scale_height",
    "mie_absorption": "mie_scale_height",
}
"""Coefficients whose coordinate is that of their column where the height is free."""

PIXELS = 200
"""Of each image, with which the grid is ranked."""

APART = 5.0
"""Standard errors between two minima."""

RIVAL = 2.0
"""χ² over that of the best minimum, up to which another one is worth telling."""


def grid(parameters: Parameters) -> Float[np.ndarray, "s n"]:
    """Coordinates of the atmospheres to try; the first is the start."""
    axes = [axis for axis in AXES if set(axis) & set(parameters.fields)]
    # 0 comes first, and with it the start itself.
    steps = product((0, -1, 1), repeat=len(axes))
    return np.stack(
        [_moved(parameters, {name: s for axis, s in zip(axes, step, strict=True) for name in axis}) for step in steps]
    )


def _moved(parameters: Parameters, steps: dict[str, int]) -> Float[np.ndarray, " n"]:
    """The start, every field moved by so many steps, at coefficients that do not follow the heights."""
    factors = {name: FACTORS[name] ** step for name, step in steps.items() if name in FACTORS}
    free = set(parameters.fields)
    parts = []
    for block in parameters.blocks:
        field = block.fields[0]
        height = OF_HEIGHT.get(field)
        factor = factors.get(field, 1.0) * (factors.get(height, 1.0) if height in free else 1.0)
        parts.append(_scaled(block, factor, ASYMMETRY * steps.get("mie_g", 0)))
    lower, upper = (np.asarray(limit) for limit in parameters.limits)
    return np.clip(np.concatenate(parts), lower, upper)


def _scaled(block: Block, factor: float, shift: float) -> Float[np.ndarray, " n"]:
    """Coordinates of ``block`` at its start times ``factor``, or, for g, plus ``shift``."""
    start = block.start
    if isinstance(block, Aerosol):
        return np.asarray(start.at[0].add(np.log(factor)))
    if not isinstance(block, Single) or (factor == 1 and (block.field != "mie_g" or shift == 0)):
        return np.asarray(start)
    value = block.bijection.value(start)
    moved = jnp.clip(value + shift, -LARGEST_ASYMMETRY, LARGEST_ASYMMETRY) if block.field == "mie_g" else factor * value
    return np.asarray(block.bijection.coordinate(moved))


def thinned(batch: Batch, count: int = PIXELS) -> tuple[Batch, Int[np.ndarray, "image p"]]:
    """``batch`` with ``count`` pixels of each image, evenly among those used, and which they are.

    Of an image with fewer some are there more than once: another number would need another program.
    """
    used = np.asarray(batch.used)
    size = min(count, used.shape[1])
    chosen = np.stack([np.flatnonzero(row)[np.linspace(0, row.sum() - 1, size).astype(int)] for row in used])
    image = np.arange(len(used))[:, None]
    of_pixels = {name: jax.device_put(np.asarray(getattr(batch, name))[image, chosen]) for name in batch.pixel_fields}
    return replace(batch, tiles=1, mesh=None, **of_pixels), chosen


def radiances(points: Float[Array, "s n"], problem: Problem) -> Float[Array, "s image p w"]:
    """The radiance of all pixels at every point, one after the other: the memory is that of one."""

    nuisances = problem.batch.nuisances
    views = problem.batch.views(nuisances.moved(jnp.zeros(nuisances.offsets, points.dtype)))

    def one(coordinates: Coordinates) -> Predicted:
        return predict(problem.sky, problem.parameters.atmosphere(coordinates), views)

    return jax.lax.map(one, points)


def ranked(problem: Problem) -> list[Float[np.ndarray, " n"]]:
    """The points of the grid, the one that is nearest to the images first.

    Exposures are set for each, offsets are zero. The start itself is left out, and so are neighbours
    of better points: a search from there would end where the better one's does.
    """
    points = grid(problem.parameters)
    batch, chosen = thinned(problem.batch)
    image = np.arange(len(chosen))[:, None]
    thin = replace(
        problem, batch=batch, weight=problem.weight[image, chosen], correction=None, priors=None, loss=None, fields=None
    )
    found = np.asarray(outermost(radiances)(array(points, problem.parameters.start.dtype), thin), dtype=np.float64)
    measured, noise = np.asarray(batch.measured, float), np.asarray(thin.weight, float)
    known = (measured > 0) & np.asarray(batch.used)[..., None]
    off = []
    for radiance in found:
        expected = radiance * np.asarray(outermost(Batch.exposure)(batch, array(starting(radiance, batch))))
        ratio = np.where(known, np.maximum(expected, 1e-30) / np.where(known, measured, 1), 1)
        off.append(float(np.mean(np.abs(np.log(ratio)) * noise * measured)))
    order = np.argsort(np.where(np.isfinite(off), off, np.inf), kind="stable")
    kept: list[int] = []
    for number in order[order != 0]:
        if np.isfinite(off[number]) and all(
            np.abs(_place(number, points) - _place(other, points)).sum() > 1 for other in kept
        ):
            kept.append(int(number))
    return [points[number] for number in kept]


def _place(number: int, points: Float[np.ndarray, "s n"]) -> Int[np.ndarray, " axis"]:
    """Where on the grid a point is, from -1 to 1 along each axis."""
    axes = round(np.log(len(points)) / np.log(3))
    digits = [number // 3**power % 3 for power in range(axes)]
    return np.array([(0, -1, 1)[digit] for digit in digits])


def separation(
    a: Float[np.ndarray, " n"],
    b: Float[np.ndarray, " n"],
    factors: Sequence[Float[np.ndarray, "n+1 n+1"]],
    misfit: float,
) -> float:
    """Standard errors between two minima, by that of their linear models by which it is less.

    The variance of the noise is ``misfit`` times the stated one.
    """
    return min(float(np.linalg.norm(factor[:, :-1] @ (a - b))) for factor in factors) / np.sqrt(max(misfit, 1.0))
