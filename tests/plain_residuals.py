"""Residuals pixel by pixel, and rows that are pixels: what the reduced ones are held against."""

import numpy as np

from fitting.least_squares import slopes
from fitting.linearisation import derivatives
from fitting.problem import predict, whitened


def residuals(y, problem):
    """(expected - measured) / sigma of every pixel and channel, from the model itself."""
    coordinates, moved = problem.parts(problem.split(y)[0])
    atmosphere = problem.parameters.atmosphere(coordinates)
    return whitened(y, predict(problem.sky, atmosphere, problem.batch.views(moved)), problem).reshape(-1)


def jacobian(y, problem):
    """The coloured derivatives of all pixels, as many rows as residuals."""
    radiance, tangents = map(np.asarray, derivatives(problem.split(y)[0], problem))
    one = np.ones_like(radiance)[..., None]
    columns = np.concatenate([tangents, radiance[..., None], one, 0 * one], axis=-1)
    columns = (
        np.where(np.asarray(problem.batch.used)[..., None, None], columns, 0) * np.asarray(problem.weight)[..., None]
    )
    return np.swapaxes(slopes(y, np.swapaxes(columns, 1, 2), problem), 1, 2).reshape(radiance.size, -1)
