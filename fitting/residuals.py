"""Whitened residuals and their Jacobian: pure functions ``(y, problem) -> arrays``.

``y`` holds the coordinates of the atmosphere's free parameters, then the nuisances (:mod:`fitting.nuisances`): the offsets of
the views, and last the linear ones. What the model depends on, all but the linear ones, is called ``x``. Everything else,
images and geometry included, is in :class:`Problem`, whose arrays are arguments of the compiled function, never constants
inside it.

The Jacobian is coloured. Wavelengths do not mix, so all numbers of a spectral parameter share one tangent, whose
channel w is the derivative with respect to number w alone. Images do not mix either, so a component of an offset shares one
tangent among all images, and the sky stays as it is along it. Exposures and pedestals need no tangent at all. Nine parameters
at three wavelengths thus cost as many forward derivatives as there are *fields*, not numbers.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.models import Model, Moments, Sky
from fitting.batch import Batch, Views
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

    def radiance(self, sky: Sky, moved: Float[Array, "image moving"]) -> Predicted:
        """Radiance of all pixels under ``sky``, by the finer model if there is a correction."""
        radiance = predict(sky, self.batch.views(moved))
        return radiance if self.correction is None else radiance * self.correction

    @property
    def size(self) -> int:
        """Number of coordinates in ``x``."""
        return self.parameters.size + self.batch.nuisances.offsets

    def split(self, y: Coordinates) -> tuple[Coordinates, Float[Array, " k"]]:
        """``x``, and the linear nuisances."""
        return y[: self.size], y[self.size :]

    def parts(self, x: Coordinates) -> tuple[Coordinates, Float[Array, "image moving"]]:
        """The coordinates of the atmosphere, and what moves the view of each image."""
        return x[: self.parameters.size], self.batch.nuisances.moved(x[self.parameters.size :])

    @property
    def start(self) -> Coordinates:
        """``x`` at the start: no offset."""
        start = self.parameters.start
        return jnp.concatenate([start, jnp.zeros(self.batch.nuisances.offsets, start.dtype)])

    @property
    def limits(self) -> tuple[Coordinates, Coordinates]:
        """The smallest and the largest ``x``."""
        lower, upper = self.parameters.limits
        endless = jnp.full(self.batch.nuisances.offsets, jnp.inf, lower.dtype)
        return jnp.concatenate([lower, -endless]), jnp.concatenate([upper, endless])

    @property
    def known(self) -> bool:
        """Whether anything is known besides the images."""
        return self.priors is not None or self.batch.nuisances.offsets > 0


def planet_shell(model: Model, parameters: Parameters) -> Any:
    """The geometry that ``model`` would else compute in each step; None if there is none or the planet is free."""
    if not isinstance(model, Moments) or {"bottom_radius", "top_radius"} & set(parameters.fields):
        return None
    init = parameters.init
    return model.shell(bottom_radius=init.bottom_radius, top_altitude=init.top_altitude)


def predict(sky: Sky, views: Views) -> Predicted:
    """Radiance of ``sky`` in the pixels of every image.

    The images are visited in a loop of the compiled program: many compile as fast as one and need the memory of one.
    """

    def one(image: tuple[Array, Array, Array]) -> Float[Array, "pixel w"]:
        altitude, sun, directions = image
        return jnp.mean(sky.view(altitude=altitude, sun=sun).radiance(view=directions).radiance, axis=1)

    return jax.lax.map(one, tuple(views))


class Linearisation(NamedTuple):
    """The radiance of all pixels and its derivatives: a tangent for each colour of the parameters, then for each component
    of the offsets that moves any image."""

    radiance: Predicted
    tangents: Float[Array, "image pixel w colour"]


def linearise(x: Coordinates, problem: Problem) -> Linearisation:
    """The costly part: the model and its forward derivatives at ``x``."""
    coordinates, moved = problem.parts(x)
    colour, _ = problem.parameters.colours()

    def turning(sky: Sky) -> Float[Array, "image pixel w moving"]:
        def along(seed: Float[Array, " moving"]) -> Predicted:
            step = jnp.broadcast_to(seed, moved.shape)
            return jax.jvp(lambda moved: problem.radiance(sky, moved), (moved,), (step,))[1]

        return jax.vmap(along, out_axes=-1)(jnp.eye(moved.shape[-1], dtype=moved.dtype))

    def seen(coordinates: Coordinates) -> tuple[Predicted, Array | None]:
        sky = problem.sky(coordinates)
        # To the offsets the sky is a constant, so the one that is solved here serves them as well.
        still = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, sky)
        return problem.radiance(sky, moved), turning(still) if moved.shape[-1] else None

    seeds = jnp.asarray(colour == np.arange(colour.max() + 1)[:, None], dtype=coordinates.dtype)
    radiance, tangents, turns = jax.vmap(
        lambda seed: jax.jvp(seen, (coordinates,), (seed,), has_aux=True), out_axes=(None, -1, None)
    )(seeds)
    return Linearisation(radiance, tangents if turns is None else jnp.concatenate([tangents, turns], axis=-1))


def light(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Predicted:
    """Exposure times radiance: what is expected of every pixel but for the pedestal."""
    return linearisation.radiance * problem.batch.exposure(problem.split(y)[1])


def expected(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Predicted:
    """The light and the pedestal of every pixel."""
    return light(y, linearisation, problem) + problem.batch.nuisances.pedestal(problem.split(y)[1])


def residuals(y: Coordinates, problem: Problem) -> Float[Array, " residual"]:
    """(expected - measured) / sigma of every pixel and channel; 0 for those not used."""
    coordinates, moved = problem.parts(problem.split(y)[0])
    radiance = problem.radiance(problem.sky(coordinates), moved)
    return whitened(y, Linearisation(radiance, radiance[..., None]), problem).reshape(-1)


def whitened(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Predicted:
    """(expected - measured) / sigma of every pixel and channel; 0 for those not used."""
    # An unused pixel may hold anything, and 0 * NaN is NaN.
    difference = expected(y, linearisation, problem) - problem.batch.measured
    return jnp.where(problem.batch.used[..., None], difference, 0) * problem.weight


def jacobian(
    y: Coordinates, linearisation: Linearisation, problem: Problem
) -> tuple[Float[Array, " residual"], Float[Array, "residual n"]]:
    """The residuals at ``y`` and their dense Jacobian, from the linearisation at the ``x`` in ``y``."""
    _, linear = problem.split(y)
    colour, channel = problem.parameters.colours()
    batch, nuisances = problem.batch, problem.batch.nuisances
    exposure, lit = batch.exposure(linear)[..., None], light(y, linearisation, problem)
    touched = (channel == -1) | (np.arange(lit.shape[-1])[:, None] == channel)
    of_atmosphere = jnp.where(touched, linearisation.tangents[..., colour], 0) * exposure
    # No more than one component of an image's offset is a coordinate's.
    own = nuisances.offset_index[:, None, None, :, None] == jnp.arange(nuisances.offsets)
    turns = linearisation.tangents[..., colour.max() + 1 :, None]
    of_offsets = jnp.sum(jnp.where(own, turns, 0), axis=-2) * nuisances.unit * exposure
    own = jnp.any(nuisances.factor_index[:, None, :, :, None] == jnp.arange(nuisances.factors), axis=-2)
    of_factors = jnp.where(own, lit[..., None], 0)
    own = nuisances.pedestal_index[:, None, :, None] == jnp.arange(nuisances.pedestals)
    of_pedestals = jnp.broadcast_to(jnp.where(own, 1, 0).astype(lit.dtype), (*lit.shape, nuisances.pedestals))
    slope = jnp.concatenate([of_atmosphere, of_offsets, of_factors, of_pedestals], axis=-1)
    slope = jnp.where(batch.used[..., None, None], slope, 0) * problem.weight[..., None]
    return whitened(y, linearisation, problem).reshape(-1), slope.reshape(-1, y.size)


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
    slope: Float[Array, "residual n"], lit: Predicted, fields: Float[Array, "image pixel b"], problem: Problem
) -> Float[Array, "image w b n"]:
    """Jᵀ of the residuals that a relative error of the light by each of ``fields``, in one image and channel, causes."""
    by_pixel = slope.reshape(*lit.shape, -1)
    return jnp.einsum("ipwn,ipw,ipb->iwbn", by_pixel, lit * problem.weight, fields)


def triangle(residual: Float[Array, " residual"], slope: Float[Array, "residual n"]) -> Float[Array, "n+1 n+1"]:
    """The triangular factor of [J r], which holds everything that least squares needs to know of both.

    With Q orthogonal and [J r] = Q [[R, z], [0, ρ]]: JᵀJ = RᵀR, Jᵀr = Rᵀz and |r|² = |z|² + ρ². Unlike JᵀJ it does
    not square the condition number, which in float32 decides whether a weakly determined parameter is seen at all.
    """
    return jnp.linalg.qr(jnp.concatenate([slope, residual[:, None]], axis=-1), mode="r")


def reduce(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Float[Array, "n+1 n+1"]:
    """The triangular factor of the whole problem at ``y``: the images with their loss, and what is known besides."""
    factor = reduce_images(y, linearisation, problem)
    if not problem.known:
        return factor
    known, pull = prior_rows(y, problem)
    return triangle(jnp.concatenate([factor[:, -1], known]), jnp.concatenate([factor[:, :-1], pull]))


def reduce_images(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Float[Array, "n+1 n+1"]:
    """The triangular factor of the images alone, with their loss."""
    residual, slope = jacobian(y, linearisation, problem)
    if problem.loss is None:
        return triangle(residual, slope)
    off = residual.reshape(linearisation.radiance.shape)
    weight, total = problem.loss(off)
    root = jnp.broadcast_to(jnp.sqrt(weight)[..., None], off.shape).reshape(-1)
    factor = triangle(root * residual, root[:, None] * slope)
    # The squares of the weighted residuals are less than the loss, whose gradient they have.
    beyond = total - jnp.sum((root * residual) ** 2)
    return factor.at[-1, -1].set(jnp.sqrt(factor[-1, -1] ** 2 + jnp.maximum(beyond, 0)))


def prior_rows(y: Coordinates, problem: Problem) -> tuple[Float[Array, " k"], Float[Array, "k n"]]:
    """Residuals of what is known besides the images, and their derivatives: of the priors, and of every offset.

    An offset is 0 ± 1 in its unit.
    """
    size, priors = problem.parameters.size, problem.priors

    def of(y: Coordinates) -> Float[Array, " k"]:
        offsets = y[size : problem.size]
        if priors is None:
            return offsets
        return jnp.concatenate([priors.residuals(problem.parameters.atmosphere(y[:size])), offsets])

    return of(y), jax.jacfwd(of)(y)
