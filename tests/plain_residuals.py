"""Residuals pixel by pixel, and rows that are pixels: what the reduced ones are held against."""

import equinox as eqx
import numpy as np
from few_programs import COMPILE_FAST

from fitting.least_squares import slopes
from fitting.linearisation import derivatives
from fitting.problem import predict, whitened

_derivatives = eqx.filter_jit(derivatives, compiler_options=COMPILE_FAST)


def residuals(y, problem):
    """(expected - measured) / sigma of every pixel and channel, from the model itself."""
    coordinates, moved = problem.parts(problem.split(y)[0])
    atmosphere = problem.parameters.atmosphere(coordinates)
    radiance = predict(problem.sky, atmosphere, problem.batch.views(moved)) * problem.batch.modulation(moved)
    return whitened(y, radiance, problem).reshape(-1)


def jacobian(y, problem):
    """The coloured derivatives of all pixels, as many rows as residuals."""
    radiance, tangents = map(np.asarray, _derivatives(problem.split(y)[0], problem))
    one = np.ones_like(radiance)[..., None]
    columns = np.concatenate([tangents, radiance[..., None], one, 0 * one], axis=-1)
    columns = (
        np.where(np.asarray(problem.batch.used)[..., None, None], columns, 0) * np.asarray(problem.weight)[..., None]
    )
    return np.swapaxes(slopes(y, np.swapaxes(columns, 1, 2), problem), 1, 2).reshape(radiance.size, -1)
