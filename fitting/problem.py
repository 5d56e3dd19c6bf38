"""A fit as a problem of least squares: what the whitened residuals depend on.

``y`` holds the coordinates of the atmosphere's free parameters, then the nuisances (:mod:`fitting.nuisances`): the offsets of
the views, and last the linear ones. What the model depends on, all but the linear ones, is called ``x``. Everything else,
images and geometry included, is in :class:`Problem`, whose arrays are arguments of the compiled functions, never constants
inside them.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffatmo.atmosphere import Atmosphere
from diffatmo.models import Model, Moments, Sky
from diffatmo.models.base import View
from diffatmo.numerics import array
from fitting.batch import Batch, Views
from fitting.correction import Correction
from fitting.observation import sigma
from fitting.parameters import Coordinates, Parameters
from fitting.priors import Priors
from fitting.robust import Loss
from fitting.smooth import Fields

Predicted = Float[Array, "image pixel w"]
Linear = Float[Array, " l"]


class Problem(eqx.Module):
    """All that the residuals depend on besides ``y``.

    ``weight`` is 1/sigma, and 0 for pixels that are not used; ``shell`` is what the model knows of the planet alone, if
    it makes use of that and the planet is not free. ``correction`` is what a finer model says over what this one says.
    ``loss`` is what outliers are given, if they are not given their squares, and ``fields`` are the forms that errors of the
    model may have. ``understated`` is the factor by which the residuals turned out larger than the stated noise: sigma is as
    stated, and so what is known besides counts for so much more beside the images.
    """

    model: Model
    parameters: Parameters
    batch: Batch
    weight: Predicted
    shell: Any = None
    correction: Correction | None = None
    priors: Priors | None = None
    loss: Loss | None = None
    fields: Fields | None = None
    understated: Float[Array, ""] = eqx.field(default_factory=lambda: array(1.0))

    def sky(self, atmosphere: Atmosphere) -> Sky:
        """The sky of ``atmosphere``, by the model."""
        if isinstance(self.model, Moments) and self.shell is not None:
            return self.model.sky(atmosphere, self.shell)
        return self.model.sky(atmosphere)

    @property
    def size(self) -> int:
        """Number of coordinates in ``x``."""
        return self.parameters.size + self.batch.nuisances.offsets

    def split(self, y: Coordinates) -> tuple[Coordinates, Linear]:
        """``x``, and the linear nuisances."""
        return y[: self.size], y[self.size :]

    def parts(self, x: Coordinates) -> tuple[Coordinates, Float[Array, "image moving"]]:
        """The coordinates of the atmosphere, and what moves the view of each image."""
        return x[: self.parameters.size], self.batch.nuisances.moved(x[self.parameters.size :])

    @property
    def start(self) -> Coordinates:
        """``x`` at the start: no offset."""
        start = self.parameters.start
        return jnp.concatenate([start, np.zeros(self.batch.nuisances.offsets, start.dtype)])

    def colours(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """For each coordinate of the atmosphere the tangent it shares, and the one channel it touches, -1 for all of them.

        Channels that are wavelengths do not mix. Channels that are bands see all wavelengths: no tangent is shared.
        """
        if self.batch.response is None:
            return self.parameters.colours()
        every = np.arange(self.parameters.size)
        return every, np.full_like(every, -1)

    @property
    def known(self) -> bool:
        """Whether anything is known besides the images."""
        return self.priors is not None or self.batch.nuisances.offsets > 0


def limits_of(problem: Problem) -> tuple[Coordinates, Coordinates]:
    """The smallest and the largest ``x``."""
    lower, upper = problem.parameters.limits
    endless = jnp.full(problem.batch.nuisances.offsets, jnp.inf, lower.dtype)
    return jnp.concatenate([lower, -endless]), jnp.concatenate([upper, endless])


def planet_shell(model: Model, parameters: Parameters) -> Any:
    """The geometry that ``model`` would else compute in each step; None if there is none or the planet is free."""
    if not isinstance(model, Moments) or {"bottom_radius", "top_radius"} & set(parameters.fields):
        return None
    init = parameters.init
    return model.shell(bottom_radius=init.bottom_radius, top_altitude=init.top_altitude)


def seen(
    view: View, directions: Float[Array, "pixel part 3"], response: Float[Array, "channel w"] | None
) -> Float[Array, "pixel channel"]:
    """The radiance of pixels, the mean over their parts, as their channels see it."""
    spectrum = jnp.mean(view.radiance(view=directions).radiance, axis=1)
    return spectrum if response is None else jnp.matmul(spectrum, response.T, precision="highest")


def hazier(atmosphere: Atmosphere, log_factor: Float[Array, ""] | None) -> Atmosphere:
    """``atmosphere`` with so much more aerosol of the same kind; None for as much."""
    if log_factor is None:
        return atmosphere
    more = jnp.exp(log_factor)
    return eqx.tree_at(
        lambda a: (a.mie_scattering, a.mie_absorption),
        atmosphere,
        (more * atmosphere.mie_scattering, more * atmosphere.mie_absorption),
    )


def predict(make: Callable[[Atmosphere], Sky], atmosphere: Atmosphere, views: Views, tiles: int = 1) -> Predicted:
    """Radiance in the pixels of every image of the skies that ``make`` makes: one for all, unless their aerosols differ.

    The images, and ``tiles`` of each, are visited in loops of the compiled program: many compile as fast as one and need the
    memory of one.
    """

    shared = make(atmosphere) if views.aerosol is None else None

    def one(image: Views) -> Float[Array, "pixel w"]:
        altitude, sun, directions, aerosol, response = image
        sky = make(hazier(atmosphere, aerosol)) if shared is None else shared
        view = sky.view(altitude=altitude, sun=sun)
        tiled = directions.reshape(tiles, -1, *directions.shape[1:])
        found = jax.lax.map(lambda tile: seen(view, tile, response), tiled)
        return found.reshape(-1, found.shape[-1])

    return jax.lax.map(one, views)


def light(y: Coordinates, radiance: Predicted, problem: Problem) -> Predicted:
    """Exposure times radiance: what is expected of every pixel but for the pedestal."""
    return radiance * problem.batch.exposure(problem.split(y)[1])


def lit_weights(y: Coordinates, radiance: Predicted, problem: Problem) -> Predicted:
    """1/sigma of the light that is expected."""
    return weights(problem.batch, light(y, radiance, problem))


def expected(y: Coordinates, radiance: Predicted, problem: Problem) -> Predicted:
    """The light and the pedestal of every pixel."""
    return light(y, radiance, problem) + problem.batch.nuisances.pedestal(problem.split(y)[1])


def whitened(y: Coordinates, radiance: Predicted, problem: Problem) -> Predicted:
    """(expected - measured) / sigma of every pixel and channel; 0 for those not used."""
    # An unused pixel may hold anything, and 0 * NaN is NaN.
    difference = expected(y, radiance, problem) - problem.batch.measured
    return jnp.where(problem.batch.used[..., None], difference, 0) * problem.weight


def weights(batch: Batch, light: Predicted) -> Predicted:
    """1/sigma of pixels whose signal is ``light``, 0 of those not used."""
    return jnp.where(batch.used[..., None], 1 / sigma(batch, light), 0)
