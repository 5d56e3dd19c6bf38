"""Whitened residuals and their Jacobian: pure functions ``(y, problem) -> arrays``.

``y`` holds the coordinates of the atmosphere's free parameters, then the logarithms of the free exposure factors. Everything
else, images and geometry included, is in :class:`Problem`, whose arrays are arguments of the compiled function, never
constants inside it.

The Jacobian is coloured. Wavelengths do not mix, so all numbers of a spectral parameter share one tangent, whose channel w
is the derivative with respect to number w alone; exposures need no tangent at all. Nine parameters at three wavelengths
thus cost as many forward derivatives as there are *fields*, not numbers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from diffatmo.models.base import Model, Sky
from fitting.observation import Batch
from fitting.parameters import Coordinates, Parameters

Predicted = Float[Array, "image pixel w"]


class Problem(eqx.Module):
    """All that the residuals depend on besides ``y``; ``weight`` is 1/sigma, and 0 for pixels that are not used."""

    model: Model
    parameters: Parameters
    batch: Batch
    weight: Predicted

    def split(self, y: Coordinates) -> tuple[Coordinates, Float[Array, " e"]]:
        """The coordinates of the atmosphere, and the logarithms of the exposures."""
        return y[: self.parameters.size], y[self.parameters.size :]

    def side(self, y: Coordinates) -> Int[Array, " n"]:
        """-1 or +1 for each coordinate whose value is as good as at its lower or upper bound, else 0."""
        coordinates, log_factors = self.split(y)
        return jnp.concatenate([self.parameters.side(coordinates), jnp.zeros(log_factors.size, int)])


def predict(sky: Sky, batch: Batch) -> Predicted:
    """Radiance of ``sky`` in the pixels of every image.

    The images are visited in a loop of the compiled program: many compile as fast as one and need the memory of one.
    """

    def one(image: tuple[Array, Array, Array]) -> Float[Array, "pixel w"]:
        altitude, sun, directions = image
        return sky.view(altitude=altitude, sun=sun).radiance(view=directions).radiance

    return jax.lax.map(one, (batch.altitude, batch.sun, batch.directions))


def signal(y: Coordinates, problem: Problem) -> Predicted:
    """What the pixels should read: radiance times exposure."""
    coordinates, log_factors = problem.split(y)
    sky = problem.model.sky(problem.parameters.atmosphere(coordinates))
    return predict(sky, problem.batch) * problem.batch.exposure(log_factors)


def residuals(y: Coordinates, problem: Problem) -> Float[Array, " residual"]:
    """(expected - measured) / sigma of every pixel and channel; 0 for those not used."""
    return _whiten(signal(y, problem), problem).reshape(-1)


def _whiten(expected: Predicted, problem: Problem) -> Predicted:
    # An unused pixel may hold anything, and 0 * NaN is NaN.
    difference = jnp.where(problem.batch.used[..., None], expected - problem.batch.measured, 0)
    return difference * problem.weight


def linearise(
    y: Coordinates, problem: Problem
) -> tuple[Predicted, Float[Array, " residual"], Float[Array, "residual n"]]:
    """The signal, the residuals, and their dense Jacobian."""
    coordinates, log_factors = problem.split(y)
    colour, channel = problem.parameters.colours()
    batch = problem.batch

    def radiance(c: Coordinates) -> Predicted:
        return predict(problem.model.sky(problem.parameters.atmosphere(c)), batch)

    seeds = jnp.asarray(colour == jnp.arange(colour.max() + 1)[:, None], dtype=y.dtype)
    predicted, tangents = jax.vmap(lambda seed: jax.jvp(radiance, (coordinates,), (seed,)), out_axes=(None, -1))(seeds)
    exposure = batch.exposure(log_factors)
    expected = predicted * exposure

    channels = jnp.arange(predicted.shape[-1])
    touched = (channel == -1) | (channels[:, None] == channel)
    of_atmosphere = jnp.where(touched, tangents[..., colour], 0) * exposure[..., None]
    of_exposure = jnp.where(
        batch.exposure_index[:, None, :, None] == jnp.arange(batch.exposure_count), expected[..., None], 0
    )
    jacobian = jnp.concatenate([of_atmosphere, of_exposure], axis=-1)
    jacobian = jnp.where(batch.used[..., None, None], jacobian, 0) * problem.weight[..., None]
    return expected, _whiten(expected, problem).reshape(-1), jacobian.reshape(-1, y.size)


def triangle(residual: Float[Array, " residual"], jacobian: Float[Array, "residual n"]) -> Float[Array, "n+1 n+1"]:
    """The triangular factor of [J r], which holds everything that least squares needs to know of both.

    With Q orthogonal and [J r] = Q [[R, z], [0, ρ]]: JᵀJ = RᵀR, Jᵀr = Rᵀz and |r|² = |z|² + ρ². Unlike JᵀJ it does not square
    the condition number, which in float32 decides whether a weakly determined parameter is seen at all.
    """
    return jnp.linalg.qr(jnp.concatenate([jacobian, residual[:, None]], axis=-1), mode="r")
