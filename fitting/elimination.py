"""Factors and pedestals, eliminated: given the radiance of the model, their optimum follows.

*The optimum.* A pixel is e L + b, with the radiance L, a factor e and a pedestal b of its image and channel. However many
pixels there are, χ² as a function of e and b is held by the triangular factor of [L 1 d] / sigma, d the measured pixels: a few
numbers for each image and channel, part of the rows of a linearisation. From them the optimum of all factors and pedestals is
found at once, whichever images and channels share them. The logarithms of shared factors add up, which is not linear in them:
a few steps of Gauss and Newton are taken, each of which costs nothing (:func:`optimum`). The weights of a robust loss are held;
:mod:`fitting.search` goes through the pixels again where they change much.

*The step.* With the linear coordinates at their optimum wherever χ² is evaluated, the fit is one in the others, x, alone: of
the smallest χ² that any factors and pedestals allow. Its Gauss-Newton step needs the derivatives of the residuals less what the
linear columns J_l span,

    (1 - P) J_x,    P the projection on the columns of J_l

(Golub & Pereyra 1973, SIAM J. Numer. Anal. 10, 413, without the term that vanishes with the residuals: Kaufman 1975, BIT 15,
49). That is the step in x of the problem in all coordinates, so nothing is approximated; but damping does not restrain the
linear coordinates, and a wrong exposure costs no step. The covariance is that of all coordinates, from the whole Jacobian at
the optimum.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffatmo.numerics import array
from fitting.batch import Batch
from fitting.linearisation import Linearisation
from fitting.nuisances import Nuisances
from fitting.parameters import Coordinates
from fitting.problem import Problem

RANK_TOLERANCE = 3e-5
"""Singular values of J, scaled to columns of length one, below this are rounding: J is computed in float32."""

STEPS, LONGEST_STEP = 50, 1.0
"""Of Gauss and Newton, and the largest change of the logarithm of a factor in one."""

REACH = 3.0
"""Change of such a logarithm beyond which an optimum is not followed: where the model is the image's negative, no factor is
small enough."""

SETTLED = 1e-3
"""Fall of χ² below which the optimum is found."""


def channel_columns(linearisation: Linearisation, problem: Problem) -> Float[np.ndarray, "image w rows 3"]:
    """Rows of [radiance, 1, measured] / sigma of every image and channel, in the known part of the exposure."""
    linear, batch = linearisation.linear, problem.batch
    rows = np.asarray(linearisation.rows, dtype=np.float64)
    known = np.asarray(batch.exposure_value, dtype=np.float64)[:, None, None]
    of_channel = lambda values: np.swapaxes(np.asarray(values, dtype=np.float64), 1, 2)
    lit, one = known * rows[..., -3], rows[..., -2]
    factor, pedestal = (of_channel(of(linear)) for of in (batch.nuisances.factor, batch.nuisances.pedestal))
    return np.stack([lit, one, factor * lit + pedestal * one - rows[..., -1]], axis=-1)


class _Curve(NamedTuple):
    """Residuals of the channels and their derivatives in the linear coordinates."""

    residual: Float[np.ndarray, " r"]
    slope: Float[np.ndarray, "r k"]

    @property
    def chi2(self) -> float:
        return float(self.residual @ self.residual)


def optimum(
    linear: Float[np.ndarray, " k"], columns: Float[np.ndarray, "image w rows 3"], nuisances: Nuisances
) -> tuple[Float[np.ndarray, " k"], float]:
    """The linear coordinates of the smallest χ², from ``linear`` on, and by how much it has fallen."""
    numbers = np.arange(nuisances.factors)
    in_factor = np.sum(np.asarray(nuisances.factor_index)[..., None] == numbers, axis=-2)
    in_pedestal = np.asarray(nuisances.pedestal_index)[..., None] == np.arange(nuisances.pedestals)
    lit, black, measured = np.moveaxis(columns, -1, 0)

    def at(linear: Float[np.ndarray, " k"]) -> _Curve:
        factor = np.exp(in_factor @ linear[: nuisances.factors])[..., None]
        pedestal = (in_pedestal @ linear[nuisances.factors :])[..., None]
        residual = factor * lit + pedestal * black - measured
        slopes = [(factor * lit)[..., None] * in_factor[..., None, :], black[..., None] * in_pedestal[..., None, :]]
        return _Curve(residual.ravel(), np.concatenate(slopes, axis=-1).reshape(residual.size, -1))

    start, here = linear, at(linear)
    first = here.chi2
    for _ in range(STEPS):
        length = np.linalg.norm(here.slope, axis=0)
        scale = np.where(length > 0, length, 1)
        step = np.linalg.lstsq(here.slope / scale, -here.residual, rcond=RANK_TOLERANCE)[0] / scale
        largest = np.max(np.abs(step[: nuisances.factors]), initial=0.0)
        step *= min(1.0, LONGEST_STEP / largest) if largest > 0 else 1.0
        before = here
        for _ in range(STEPS):
            there = at(linear + step)
            if there.chi2 <= before.chi2:
                break
            step = step / 2
        moved = linear + step
        within = np.max(np.abs(moved - start)[: nuisances.factors], initial=0.0) <= REACH
        if not (there.chi2 <= before.chi2 and within):
            break
        linear, here = moved, there
        if before.chi2 - here.chi2 < 1e-3 * SETTLED:
            break
    return linear, first - here.chi2


def eliminate(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Coordinates:
    """``y`` with its linear coordinates at the optimum for the radiance of ``linearisation``."""
    nuisances = problem.batch.nuisances
    columns = channel_columns(linearisation, problem) if nuisances.linear else np.zeros(0)
    if not (nuisances.linear and np.all(np.isfinite(columns))):
        return y
    x, linear = problem.split(y)
    better, _ = optimum(np.asarray(linear, dtype=np.float64), columns, nuisances)
    return jnp.concatenate([x, array(better, y.dtype)])


def starting(radiance: np.ndarray, batch: Batch) -> Float[np.ndarray, " k"]:
    """Linear coordinates that bring the median of measured / expected to one: a neutral white balance, no pedestal.

    A robust loss needs a start at which most pixels are no outliers.
    """
    if not batch.nuisances.linear:
        return np.zeros(0)
    lit = radiance * np.asarray(batch.exposure_value)[:, None, None]
    ratio = np.asarray(batch.measured) / np.where(lit > 0, lit, np.inf)
    usable = np.asarray(batch.used)[..., None] & (ratio > 0) & np.isfinite(ratio)
    index = np.broadcast_to(np.asarray(batch.nuisances.factor_index)[:, None, :, 0], ratio.shape)
    chosen = [ratio[usable & (index == number)] for number in range(batch.nuisances.factors)]
    logs = [np.log(np.median(values)) if values.size else 0.0 for values in chosen]
    return np.array([*logs, *[0.0] * batch.nuisances.pedestals])


def without(nuisance: Float[np.ndarray, "rows k"], others: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
    """The columns ``others`` less their projection on what the columns ``nuisance`` span."""
    length = np.linalg.norm(nuisance, axis=0)
    span, singular, _ = np.linalg.svd(nuisance / np.where(length > 0, length, 1), full_matrices=False)
    span = span[:, singular > RANK_TOLERANCE]
    return others - span @ (span.T @ others)


def profile(factor: Float[np.ndarray, "n+1 n+1"], linear: int) -> Float[np.ndarray, "m+1 m+1"]:
    """The triangular factor of [J r] in all coordinates but the last ``linear``, which are at their optimum.

    The sum of the squares of its last column is still χ².
    """
    if not linear:
        return factor
    size = factor.shape[1] - 1 - linear
    others = np.delete(factor, slice(size, size + linear), axis=1)
    left = np.asarray(np.linalg.qr(without(factor[:, size:-1], others), mode="r"))
    # What the optimum leaves of the linear gradient, rounding, counts but pulls at nothing.
    left[-1, -1] = np.sqrt(left[-1, -1] ** 2 + max(np.sum(factor[:, -1] ** 2) - np.sum(left[:, -1] ** 2), 0))
    return left
