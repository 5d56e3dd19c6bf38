"""What a finer model says of the one that was fitted: a correction of its light, and what may be left of its error."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from jaxtyping import Float

from diffatmo.models import Model
from fitting.elimination import RANK_TOLERANCE
from fitting.least_squares import Factor, pushes
from fitting.linearisation import AXIS, spread
from fitting.parameters import Coordinates
from fitting.problem import Predicted, Problem, predict
from fitting.search import Point

LARGEST_CORRECTION = 1.25
"""Factor beyond which a finer model is no correction any more."""

REMAINING = 1 / 5
"""Error of a finer model over the difference to the coarser one. For ``Moments`` against Monte Carlo, over the smooth part of
the sky, it is 0.03 to 0.1 in haze of optical depth 0.3 to 0.4, where the difference is 1 to 3 %, and 0.1 to 0.3 in clear air,
where it is 0.1 %; more with g above 0.8, where neither resolves the outskirts of the aureole, and the model's error is
understated (``tests/benchmarks/accuracy.py``, ``recovery.py``)."""


def ratio(x: Coordinates, problem: Problem, radiance: Predicted, finer: Model) -> Predicted:
    """What ``finer`` expects over the ``radiance`` of the problem's own model; NaN where there is nothing to compare."""
    if problem.batch.mesh is None:
        return _ratio(x, problem, radiance, finer)
    everywhere, apart = PartitionSpec(), PartitionSpec(None, AXIS)
    arrays, rest = eqx.partition(problem, eqx.is_array)
    return jax.shard_map(
        lambda x, arrays, radiance: _ratio(x, eqx.combine(arrays, rest), radiance, finer),
        mesh=problem.batch.mesh,
        in_specs=(everywhere, spread(arrays, everywhere, apart), apart),
        out_specs=apart,
        check_vma=False,
    )(x, arrays, radiance)


def _ratio(x: Coordinates, problem: Problem, radiance: Predicted, finer: Model) -> Predicted:
    coordinates, moved = problem.parts(x)
    batch = problem.batch
    wanted = predict(finer.sky, problem.parameters.atmosphere(coordinates), batch.views(moved), batch.tiles)
    if batch.shading.shape[-1]:
        wanted = wanted * batch.modulation(moved)
    known = batch.used[..., None] & (radiance > 0) & (wanted > 0)
    found = wanted / jnp.where(known, radiance, 1)
    return jnp.where(known, jnp.clip(found, 1 / LARGEST_CORRECTION, LARGEST_CORRECTION), jnp.nan)


def deviation(problem: Problem) -> Float[np.ndarray, "image w"]:
    """RMS of the correction over the used pixels of every image."""
    assert problem.correction is not None
    used = np.asarray(problem.batch.used)
    off = np.where(used[..., None], np.asarray(problem.correction.ratio) - 1, 0)
    return np.sqrt((off**2).sum(axis=1) / np.maximum(used.sum(axis=1), 1)[:, None])


def moved(before: Point, best: Point, error: Float[np.ndarray, "n n"], size: int) -> float:
    """The largest way of the first ``size`` coordinates from ``before`` to ``best``, in standard errors, ``error`` included."""
    inverse = _inverse(best.triangle)
    bars = np.sqrt(np.diag(inverse @ inverse.T + error))[:size]
    way = np.abs(np.asarray(best.y, dtype=np.float64) - np.asarray(before.y, dtype=np.float64))[:size]
    return float(np.max(way / np.where(bars > 0, bars, np.inf), initial=0.0))


def _inverse(triangle: Factor) -> Float[np.ndarray, "n k"]:
    """R⁻¹: the pseudo-inverse, as some combinations may not be determined at all."""
    length = np.linalg.norm(triangle[:, :-1], axis=0)
    scale = np.where(length > 0, length, 1)
    inverse: Float[np.ndarray, "n k"] = np.linalg.pinv(triangle[:, :-1] / scale, rcond=RANK_TOLERANCE)
    return inverse / scale[:, None]


def covariance(best: Point, problem: Problem) -> Float[np.ndarray, "n n"]:
    """Covariance of the coordinates from what the correction leaves of the model's error.

    The finer model is taken to be off by :data:`REMAINING` of what the coarser one was off there, pixel by pixel, times a
    random function of variance one that is smooth on the sky: in every image another, half of its variance common to all
    channels and half of each channel's own. Errors are so largest where the correction is, as near the horizon in haze, where
    the scale heights are read.
    """
    pushed = pushes(best.y, best.linearisation, problem)
    pushed = pushed * (REMAINING / math.sqrt(2 * pushed.shape[2]))
    every = np.concatenate([pushed.reshape(-1, best.y.size), pushed.sum(axis=1).reshape(-1, best.y.size)])
    # δy = (RᵀR)⁻¹ Jᵀ δr.
    inverse = _inverse(best.triangle)
    shifts = every @ inverse @ inverse.T
    return shifts.T @ shifts
