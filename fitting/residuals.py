"""Whitened residuals and their Jacobian: pure functions ``(y, problem) -> arrays``.

``y`` holds the coordinates of the atmosphere's free parameters, then the logarithms of the free exposure factors.
Everything else, images and geometry included, is in :class:`Problem`, whose arrays are arguments of the compiled
function, never constants inside it.

The Jacobian is coloured. Wavelengths do not mix, so all numbers of a spectral parameter share one tangent, whose
channel w is the derivative with respect to number w alone; exposures need no tangent at all. Nine parameters at three
wavelengths thus cost as many forward derivatives as there are *fields*, not numbers.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.models import Model, Moments, Sky
from fitting.observation import Batch
from fitting.parameters import Coordinates, Parameters
from fitting.priors import Priors
from fitting.robust import Loss

Predicted = Float[Array, "image pixel w"]


class Problem(eqx.Module):
    """All that the residuals depend on besides ``y``.

    ``weight`` is 1/sigma, and 0 for pixels that are not used; ``shell`` is what the model knows of the planet alone, if
    it makes use of that and the planet is not free. ``correction`` is what a finer model says, over what this one says, at
    one point near the optimum; it scales the radiance and its derivatives. ``loss`` is what outliers are given, if they are
    not given their squares.
    """

    model: Model
    parameters: Parameters
    batch: Batch
    weight: Predicted
    shell: Any = None
    correction: Predicted | None = None
    priors: Priors | None = None
    loss: Loss | None = None

    def sky(self, coordinates: Coordinates) -> Sky:
        """The sky at coordinates of the atmosphere."""
        atmosphere = self.parameters.atmosphere(coordinates)
        if isinstance(self.model, Moments) and self.shell is not None:
            return self.model.sky(atmosphere, self.shell)
        return self.model.sky(atmosphere)

    def radiance(self, coordinates: Coordinates) -> Predicted:
        """Radiance of all pixels, by the finer model if there is a correction."""
        radiance = predict(self.sky(coordinates), self.batch)
        return radiance if self.correction is None else radiance * self.correction

    def split(self, y: Coordinates) -> tuple[Coordinates, Float[Array, " e"]]:
        """The coordinates of the atmosphere, and the logarithms of the exposures."""
        return y[: self.parameters.size], y[self.parameters.size :]

    @property
    def limits(self) -> tuple[Coordinates, Coordinates]:
        """The smallest and the largest ``y``."""
        lower, upper = self.parameters.limits
        endless = jnp.full(self.batch.exposure_count, jnp.inf, lower.dtype)
        return jnp.concatenate([lower, -endless]), jnp.concatenate([upper, endless])


def planet_shell(model: Model, parameters: Parameters) -> Any:
    """The geometry that ``model`` would else compute in each step; None if there is none or the planet is free."""
    if not isinstance(model, Moments) or {"bottom_radius", "top_radius"} & set(parameters.fields):
        return None
    init = parameters.init
    return model.shell(bottom_radius=init.bottom_radius, top_altitude=init.top_altitude)


def predict(sky: Sky, batch: Batch) -> Predicted:
    """Radiance of ``sky`` in the pixels of every image.

    The images are visited in a loop of the compiled program: many compile as fast as one and need the memory of one.
    """

    def one(image: tuple[Array, Array, Array]) -> Float[Array, "pixel w"]:
        altitude, sun, directions = image
        return jnp.mean(sky.view(altitude=altitude, sun=sun).radiance(view=directions).radiance, axis=1)

    return jax.lax.map(one, (batch.altitude, batch.sun, batch.directions))


class Linearisation(NamedTuple):
    """The radiance of all pixels and its derivatives: one tangent per colour of the parameters."""

    radiance: Predicted
    tangents: Float[Array, "image pixel w colour"]


def linearise(coordinates: Coordinates, problem: Problem) -> Linearisation:
    """The costly part: the model and its forward derivatives at the atmosphere's ``coordinates``."""
    colour, _ = problem.parameters.colours()

    seeds = jnp.asarray(colour == np.arange(colour.max() + 1)[:, None], dtype=coordinates.dtype)
    tangent = jax.vmap(lambda seed: jax.jvp(problem.radiance, (coordinates,), (seed,)), out_axes=(None, -1))
    return Linearisation(*tangent(seeds))


def residuals(y: Coordinates, problem: Problem) -> Float[Array, " residual"]:
    """(expected - measured) / sigma of every pixel and channel; 0 for those not used."""
    coordinates, log_factors = problem.split(y)
    radiance = problem.radiance(coordinates)
    return _whiten(radiance * problem.batch.exposure(log_factors), problem).reshape(-1)


def _whiten(expected: Predicted, problem: Problem) -> Predicted:
    # An unused pixel may hold anything, and 0 * NaN is NaN.
    difference = jnp.where(problem.batch.used[..., None], expected - problem.batch.measured, 0)
    return difference * problem.weight


def jacobian(
    y: Coordinates, linearisation: Linearisation, problem: Problem
) -> tuple[Float[Array, " residual"], Float[Array, "residual n"]]:
    """The residuals at ``y`` and their dense Jacobian, from the linearisation at the atmosphere's coordinates in
    ``y``."""
    _, log_factors = problem.split(y)
    colour, channel = problem.parameters.colours()
    batch = problem.batch
    exposure = batch.exposure(log_factors)
    expected = linearisation.radiance * exposure
    touched = (channel == -1) | (np.arange(expected.shape[-1])[:, None] == channel)
    of_atmosphere = jnp.where(touched, linearisation.tangents[..., colour], 0) * exposure[..., None]
    own = jnp.any(batch.exposure_index[:, None, :, :, None] == jnp.arange(batch.exposure_count), axis=-2)
    of_exposure = jnp.where(own, expected[..., None], 0)
    slope = jnp.concatenate([of_atmosphere, of_exposure], axis=-1)
    slope = jnp.where(batch.used[..., None, None], slope, 0) * problem.weight[..., None]
    return _whiten(expected, problem).reshape(-1), slope.reshape(-1, y.size)


def whitened(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Predicted:
    """(expected - measured) / sigma of every pixel and channel; 0 for those not used."""
    expected = linearisation.radiance * problem.batch.exposure(problem.split(y)[1])
    return _whiten(expected, problem)


def smooth_fields(batch: Batch, degree: int) -> Float[np.ndarray, "image pixel b"]:
    """Polynomials of the view direction, orthogonal over the used pixels of each image, of mean square one there.

    A sum of them with independent coefficients of variance s²/b is a random smooth function on the sky of variance s².
    """
    directions = np.asarray(batch.directions, dtype=np.float64).mean(axis=2)
    powers = [
        (i, j, k) for i in range(degree + 1) for j in range(degree + 1 - i) for k in range(min(2, degree + 1 - i - j))
    ]
    monomials = np.stack([np.prod(directions**power, axis=-1) for power in np.array(powers, float)], axis=-1)
    used = np.asarray(batch.used)[..., None]
    orthogonal = np.stack([np.linalg.qr(field)[0] for field in np.where(used, monomials, 0)])
    return orthogonal * np.sqrt(used.sum(axis=1, keepdims=True))


def projected(
    slope: Float[Array, "residual n"], expected: Predicted, fields: Float[Array, "image pixel b"], problem: Problem
) -> Float[Array, "image w b n"]:
    """Jᵀ of the residuals that a relative error of the radiance by each of ``fields``, in one image and channel, causes."""
    by_pixel = slope.reshape(*expected.shape, -1)
    return jnp.einsum("ipwn,ipw,ipb->iwbn", by_pixel, expected * problem.weight, fields)


def triangle(residual: Float[Array, " residual"], slope: Float[Array, "residual n"]) -> Float[Array, "n+1 n+1"]:
    """The triangular factor of [J r], which holds everything that least squares needs to know of both.

    With Q orthogonal and [J r] = Q [[R, z], [0, ρ]]: JᵀJ = RᵀR, Jᵀr = Rᵀz and |r|² = |z|² + ρ². Unlike JᵀJ it does
    not square the condition number, which in float32 decides whether a weakly determined parameter is seen at all.
    """
    return jnp.linalg.qr(jnp.concatenate([slope, residual[:, None]], axis=-1), mode="r")


def reduce(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Float[Array, "n+1 n+1"]:
    """The triangular factor of the whole problem at ``y``: the images with their loss, and the priors."""
    residual, slope = jacobian(y, linearisation, problem)
    beyond: Float[Array, ""] | float = 0.0
    if problem.loss is not None:
        whitened = residual.reshape(linearisation.radiance.shape)
        weight, total = problem.loss(whitened)
        root = jnp.broadcast_to(jnp.sqrt(weight)[..., None], whitened.shape).reshape(-1)
        residual, slope = root * residual, root[:, None] * slope
        # The squares of the weighted residuals are less than the loss, whose gradient they have.
        beyond = total - jnp.sum(residual**2)
    if problem.priors is not None:
        known, pull = prior_rows(y, problem.priors, problem)
        residual, slope = jnp.concatenate([residual, known]), jnp.concatenate([slope, pull])
    factor = triangle(residual, slope)
    return factor.at[-1, -1].set(jnp.sqrt(factor[-1, -1] ** 2 + jnp.maximum(beyond, 0)))


def prior_rows(y: Coordinates, priors: Priors, problem: Problem) -> tuple[Float[Array, " k"], Float[Array, "k n"]]:
    """Residuals of the priors and their derivatives."""

    def of(y: Coordinates) -> Float[Array, " k"]:
        return priors.residuals(problem.parameters.atmosphere(problem.split(y)[0]))

    return of(y), jax.jacfwd(of)(y)
