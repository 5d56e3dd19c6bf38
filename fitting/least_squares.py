"""χ² and its derivatives from the rows of a linearisation: small problems, solved in double precision by numpy.

With Q orthogonal and [J r] = Q [[R, z], [0, ρ]]: JᵀJ = RᵀR, Jᵀr = Rᵀz and |r|² = |z|² + ρ². The right side, called the
*triangular factor* of the problem, holds everything that least squares needs to know of both.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.compiling import outermost
from fitting.linearisation import Linearisation
from fitting.nuisances import Nuisances
from fitting.parameters import Coordinates
from fitting.problem import Linear, Problem

Factor = Float[np.ndarray, "n+1 n+1"]


def triangle(residual: Float[np.ndarray, " residual"], slope: Float[np.ndarray, "residual n"]) -> Factor:
    """The triangular factor of [J r], with as many rows as columns however few residuals there are."""
    columns = np.concatenate([slope, residual[:, None]], axis=-1)
    missing = max(columns.shape[1] - len(columns), 0)
    return np.asarray(np.linalg.qr(np.concatenate([columns, np.zeros((missing, columns.shape[1]))]), mode="r"))


def slopes(
    y: Coordinates, columns: Float[np.ndarray, "image w row k"], problem: Problem
) -> Float[np.ndarray, "image w row n"]:
    """Derivatives of the residuals with respect to ``y``, from columns as those of :attr:`Linearisation.rows`."""
    colour, channel = problem.colours()
    nuisances = problem.batch.nuisances
    exposure = _scales(problem.split(y)[1], problem)[0][..., None]
    tangents, lit, one = columns[..., :-3], exposure * columns[..., -3:-2], columns[..., -2:-1]
    first, turned = colour.max() + 1, colour.max() + 1 + len(nuisances.moving)
    touched = (channel == -1) | (np.arange(columns.shape[1])[:, None] == channel)
    of_atmosphere = np.where(touched[:, None], tangents[..., colour], 0) * exposure
    # No more than one component of an image's offset is a coordinate's.
    own = np.asarray(nuisances.offset_index)[..., None] == np.arange(nuisances.offsets)
    turns = tangents[..., first:turned] @ own.astype(float)[:, None]
    of_offsets = turns * np.asarray(nuisances.unit, float) * exposure
    of_x = np.concatenate([of_atmosphere, of_offsets], axis=-1)
    if problem.correction is not None:
        of_x = of_x + exposure * (tangents[..., turned:] @ np.asarray(problem.correction.along, float))
    own = (np.asarray(nuisances.factor_index)[..., None] == np.arange(nuisances.factors)).any(axis=-2)
    of_factors = np.where(own[:, :, None], lit, 0)
    own = np.asarray(nuisances.pedestal_index)[..., None] == np.arange(nuisances.pedestals)
    of_pedestals = np.where(own[:, :, None], one, 0)
    return np.concatenate([of_x, of_factors, of_pedestals], axis=-1)


def _scales(linear: Linear, problem: Problem) -> tuple[Float[np.ndarray, "image w 1"], Float[np.ndarray, "image w 1"]]:
    """What radiance is multiplied by, and what is added to it."""
    batch = problem.batch
    scales = outermost(_scales_of)(linear, batch.exposure_value, batch.nuisances)
    exposure, pedestal = (np.swapaxes(np.asarray(scale, dtype=np.float64), 1, 2) for scale in scales)
    return exposure, pedestal


def _scales_of(
    linear: Linear, exposure_value: Float[Array, " image"], nuisances: Nuisances
) -> tuple[Float[Array, "image 1 w"], Float[Array, "image 1 w"]]:
    return exposure_value[:, None, None] * nuisances.factor(linear), nuisances.pedestal(linear)


def jacobian(
    y: Coordinates, linearisation: Linearisation, problem: Problem
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r n"]]:
    """Residuals whose squares, and a Jacobian whose products, are those of all pixels at ``y``.

    The linearisation is that at the ``x`` in ``y``; its own linear nuisances may be others.
    """
    rows = np.asarray(linearisation.rows, dtype=np.float64)
    exposure, pedestal = _scales(problem.split(y)[1], problem)
    exposure_then, pedestal_then = _scales(linearisation.linear, problem)
    brighter, raised = exposure - exposure_then, pedestal - pedestal_then
    residual = rows[..., -1] + brighter * rows[..., -3] + raised * rows[..., -2]
    return residual.ravel(), slopes(y, rows, problem).reshape(residual.size, -1)


def reduce_images(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Factor:
    """The triangular factor of the images alone, with their loss.

    Where the linear nuisances are not those of the linearisation, a robust loss is no more than its last column says: it is
    concave in the squares, so the parabola of its weights lies above it.
    """
    factor = triangle(*jacobian(y, linearisation, problem))
    # The squares of the weighted residuals are less than the loss, whose gradient they have.
    factor[-1, -1] = np.sqrt(factor[-1, -1] ** 2 + max(float(linearisation.beyond), 0))
    return factor


def reduce(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Factor:
    """The triangular factor of the whole problem at ``y``: the images with their loss, and what is known besides."""
    factor = reduce_images(y, linearisation, problem)
    if not problem.known:
        return factor
    known, pull = known_rows(y, problem)
    return triangle(np.concatenate([factor[:, -1], known]), np.concatenate([factor[:, :-1], pull]))


def known_rows(y: Coordinates, problem: Problem) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k n"]]:
    """Residuals of what is known besides the images, and their derivatives: of the priors, and of the offsets.

    Both are in units of the stated noise: where that is understated, they are larger than what is known says.
    """
    residual, slope = outermost(_known_rows)(y, problem)
    return np.asarray(residual, dtype=np.float64), np.asarray(slope, dtype=np.float64)


def _known_rows(y: Coordinates, problem: Problem) -> tuple[Float[Array, " k"], Float[Array, "k n"]]:
    size, priors = problem.parameters.size, problem.priors

    def of(y: Coordinates) -> Float[Array, " k"]:
        # An offset is 0 ± 1 in its unit, or its innovation is.
        found = jnp.matmul(problem.batch.nuisances.innovation, y[size : problem.size], precision="highest")
        if priors is not None:
            found = jnp.concatenate([priors.residuals(problem.parameters.atmosphere(y[:size])), found])
        return problem.understated * found

    return of(y), jax.jacfwd(of)(y)


def pushes(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Float[np.ndarray, "image w b n"]:
    """Jᵀ of the residuals that a relative error of the light by each of the smooth fields, in one image and channel, causes."""
    columns = np.asarray(linearisation.pushes, dtype=np.float64)
    return slopes(y, columns, problem) * _scales(problem.split(y)[1], problem)[0][..., None]
