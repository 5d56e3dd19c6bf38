"""The solution of a fit by Levenberg-Marquardt, without its error bars.

Each step costs one evaluation of the model with its derivatives over all pixels, compiled once; it is reduced to the
triangular factor of [J r] (:func:`fitting.residuals.triangle`), in which optimistix then takes its step. As the loop
over steps runs in Python, progress can be shown, the time of a step is known, and an interrupt ends the fit at its
best point.

*Convergence* is judged in units of the parameters' own uncertainty, as in MINUIT: the squared distance to the
optimum, (Jᵀr)ᵀ (JᵀJ)⁻¹ Jᵀr, says by how much χ² would still fall if the residuals were linear. At a distance of 0.1
every parameter is within a tenth of its standard error of the optimum. Directions that the data leave open to more than
a natural unit of the coordinates, and parameters held by their bounds, do not count.

*Resolution.* The steps are those of the model as it is given. A model that knows a ``finer`` one of itself is then compared
with it at the optimum, and the last pass explains the images by the finer model there, with the slopes of the first.

*Linear nuisances*, exposures and pedestals, are at their optimum wherever χ² is evaluated, and the search is in the other
coordinates alone (:mod:`fitting.elimination`).

*Starts.* A search that has gone astray, which its χ² shows, is begun anew from the best atmospheres of a coarse grid
(:mod:`fitting.starts`).

*Noise.* sigma depends on the expected signal, which is known only after the fit. Taken from the noisy pixels it
favours those that came out dark, and biases the radiance by about -2 (relative noise)²: 2e-4 for 1 % noise, ten
standard errors of a well-determined parameter. So the fit starts with sigma from the measured signal, and goes on with that
from the fitted one.
"""

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from diffatmo.atmosphere import Atmosphere
from diffatmo.compiling import compile_ahead, outermost
from diffatmo.models.base import Model
from fitting._errors import FitError
from fitting.batch import Batch, stack
from fitting.checkpoint import Checkpoint, digest, load, save
from fitting.elimination import RANK_TOLERANCE, eliminate, profile, starting
from fitting.nuisances import Label, gather
from fitting.observation import Observation, sigma
from fitting.parameters import Coordinates, Parameters, select
from fitting.priors import Prior, collect
from fitting.residuals import (
    Linearisation,
    Predicted,
    Problem,
    expected,
    jacobian,
    light,
    linearise,
    planet_shell,
    predict,
    prior_rows,
    projected,
    reduce,
    reduce_images,
    smooth_fields,
    whitened,
)
from fitting.robust import Loss, scale
from fitting.starts import APART, RIVAL, ranked, separation

TOLERANCE = 0.1
"""Distance to the optimum, in standard errors, at which the fit has converged."""

MAX_STEPS = 100

FIRST_PASS_TOLERANCE = 1.0
"""The first pass only has to find the sigma of the second: one standard error from its optimum is near enough."""

ROUNDING_DISTANCE = 0.3
"""Distance below which rejected steps mean that rounding hides the last of the way."""

REJECTIONS_AT_ROUNDING = 3

REJECTIONS_AT_MOST = 11
"""Each makes the damping four times as large; after as many no step is left in float32."""

LONGEST_STEP = 3.0
"""In natural units: what the derivatives say of a parameter e³ times as large is not worth an evaluation."""

LARGEST_SIGNAL = 1e9
"""Signal over noise, of a pixel, whose square can be summed in single precision."""

LARGEST_CORRECTION = 1.25
"""Factor beyond which a finer model is no correction any more."""

LARGEST_DEVIATION = 0.03
"""RMS of the correction, in any image, beyond which the model is too coarse for the atmosphere that was found."""

LARGEST_MISFIT = 100.0
"""Reduced χ² up to which residuals are taken for noise that may hide an optimum; beyond it the model is wrong somewhere."""

ASTRAY = 2.0
"""Reduced χ² beyond which the search from the given start is not trusted to have found the best minimum."""

PATIENCE = 40
"""Steps after which a search with such a χ² is given up for others."""

OTHERS = 3
"""Starts that are tried then, at most: fewer if one leads to a better χ² than that, or to the same minimum again."""

HOPELESS_MISFIT = 1e4
"""Reduced χ² of images that have nothing to do with the model: another unit, another exposure."""

REMAINING = 1 / 5
"""Error of a finer model over the difference to the coarser one: at most that for ``Moments`` against Monte Carlo in
atmospheres of aerosol optical depth 0.1 to 0.3 and g up to 0.74, suns from 35° to 93°, once the Monte Carlo's own error is
taken off (``tests/benchmarks/accuracy.py``). Not so for g = 0.9, where neither resolves the outskirts of the aureole and the
model's error is understated."""

FIELD_DEGREE = 3
"""Degree in direction up to which the model's errors are correlated."""

SETTLED = 0.9
"""Ratio of the scales of a robust loss, from one stage to the next, above which it does not fall any further."""

INTERRUPTED = "interrupted by the user"
OUT_OF_STEPS = "stopped: not converged in the steps allowed"
UNLIKE = (
    "the images are not of such a sky: residuals are {:.0f} times the noise; are exposure, units, camera and sun right?"
)
ELSEWHERE = "{}; from one of {} other starts, as the one given leads to a χ² {:.2g} times as large"
TOO_COARSE = "converged, but the model's finer self differs from it by {:.0%}: the error bars do not hold"

# The test for convergence is made here, so optimistix's own is set out of reach. Its trust region trusts a step only if
# 99 % of the predicted fall of χ² came true, and then takes hundreds of steps along the curved valleys that images with
# few determined combinations have; with 75 % it takes tens.
_SOLVER: optx.LevenbergMarquardt = eqx.tree_at(
    lambda solver: solver.search,
    optx.LevenbergMarquardt(rtol=1e-30, atol=1e-30),
    optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=3.5),
)


class Step(NamedTuple):
    """One evaluation of the fit.

    ``chi2`` is that of the point tried (infinite where the model was), ``accepted`` whether it became the current one;
    ``change`` is the largest change of a coordinate that led to it (about the relative change of a parameter),
    ``distance`` that from the current point to the optimum, in standard errors, ``damping`` the λ of
    the next step, and ``stage`` 1 while sigma comes from the measured signal, 2 when it comes from the fitted one.
    """

    step: int
    stage: int
    chi2: float
    reduced_chi2: float
    accepted: bool
    change: float
    distance: float
    damping: float
    seconds: float


Progress = Callable[[Step], Any]


class Solution(NamedTuple):
    """The best point found and the linear model around it."""

    parameters: Parameters
    batch: Batch
    nuisances: list[Label]
    y: Coordinates
    triangle: Float[np.ndarray, "n+1 n+1"]
    predicted: Float[np.ndarray, "image pixel w"]
    model_error: Float[np.ndarray, "n n"]
    """Covariance of ``y`` from errors of the model, as far as they are known."""
    history: list[Step]
    residual_count: int
    converged: bool
    message: str
    timings: dict[str, float]
    of_images: Float[np.ndarray, "n+1 n+1"]
    """The triangular factor of the images alone."""
    of_priors: Float[np.ndarray, "k n"]
    """The derivatives of the priors' residuals."""
    inflation: float | None
    """What a robust loss makes of the covariance (:meth:`fitting.robust.Loss.inflation`)."""
    outliers: list[int]
    """Pixels of each image to which a robust loss gives less than half their weight."""
    minima: list[tuple[Coordinates, float]]
    """Coordinates and χ² of the minima, the best first, if there are several; before any correction by a finer model."""

    @property
    def chi2(self) -> float:
        """Sum of the squared whitened residuals of the images, or of what a robust loss makes of them."""
        return float(np.sum(self.of_images[:, -1] ** 2))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of residuals less number of coordinates."""
        return self.residual_count - self.y.size


def _correction(x: Coordinates, problem: Problem, radiance: Predicted, finer: Model) -> Predicted:
    """What ``finer`` expects over the ``radiance`` of the problem's own model; 1 where there is nothing to compare."""
    coordinates, moved = problem.parts(x)
    wanted = predict(finer.sky(problem.parameters.atmosphere(coordinates)), problem.batch.views(moved))
    known = problem.batch.used[..., None] & (radiance > 0) & (wanted > 0)
    ratio = wanted / jnp.where(known, radiance, 1)
    return jnp.where(known, jnp.clip(ratio, 1 / LARGEST_CORRECTION, LARGEST_CORRECTION), 1)


def _projected(
    y: Coordinates, linearisation: Linearisation, fields: Float[Array, "image pixel b"], problem: Problem
) -> Float[Array, "image w b n"]:
    _, slope = jacobian(y, linearisation, problem)
    return projected(slope, light(y, linearisation, problem), fields, problem)


def _deviation(problem: Problem) -> Float[np.ndarray, "image w"]:
    """RMS of the correction over the used pixels of every image."""
    used = np.asarray(problem.batch.used)
    deviation = np.where(used[..., None], np.asarray(problem.correction) - 1, 0)
    return np.sqrt((deviation**2).sum(axis=1) / np.maximum(used.sum(axis=1), 1)[:, None])


def _model_error(best: "Point", problem: Problem) -> Float[np.ndarray, "n n"]:
    """Covariance of the coordinates from what the correction leaves of the model's error.

    The finer model is taken to be off by :data:`REMAINING` of what the coarser one was off: in every image by a smooth random
    function of direction, half of its variance common to all channels and half of each channel's own. Its amplitude is the
    RMS of the correction there.
    """
    amplitude = REMAINING * _deviation(problem)
    fields = smooth_fields(problem.batch, FIELD_DEGREE)
    pushes = np.asarray(
        outermost(_projected)(best.y, best.linearisation, jnp.asarray(fields, best.y.dtype), problem), dtype=np.float64
    )
    pushes *= amplitude[:, :, None, None] / math.sqrt(2 * fields.shape[-1])
    pushes = np.concatenate([pushes.reshape(-1, best.y.size), pushes.sum(axis=1).reshape(-1, best.y.size)])
    # δy = (RᵀR)⁻¹ Jᵀ δr: through the pseudo-inverse, as some combinations may not be determined at all.
    length = np.linalg.norm(best.triangle[:, :-1], axis=0)
    scale = np.where(length > 0, length, 1)
    inverse = np.linalg.pinv(best.triangle[:, :-1] / scale, rcond=RANK_TOLERANCE) / scale[:, None]
    shifts = pushes @ inverse @ inverse.T
    return shifts.T @ shifts


def _tangent_plane(y: Coordinates, plane: tuple[Array, Array, Array]) -> tuple[Array, None]:
    residual, jacobian, origin = plane
    # A sum, not a matrix product, which accelerators may run in reduced precision.
    return residual + jnp.sum(jacobian * (y - origin), axis=-1), None


def _start(y: Coordinates) -> Any:
    n = y.size
    plane = (jnp.zeros(n + 1, y.dtype), jnp.zeros((n + 1, n), y.dtype), y)
    residual = jax.ShapeDtypeStruct((n + 1,), y.dtype)
    return _SOLVER.init(_tangent_plane, y, plane, {}, residual, None, frozenset())


def _step(y: Coordinates, state: Any, plane: tuple[Array, Array, Array]) -> tuple[Coordinates, Any]:
    y, state, _ = _SOLVER.step(_tangent_plane, y, plane, {}, state, frozenset())
    return y, state


def distance(factor: Float[np.ndarray, "n+1 n+1"], misfit: float = 1.0) -> float:
    """Distance to the optimum, in standard errors, in the directions that the data determine.

    Its square is the amount by which χ² / ``misfit`` would still fall if the residuals were linear; the variance of the
    noise is taken to be ``misfit`` times the stated one. A direction with the standard error s, in natural units of the
    coordinates, counts by 1 / (1 + s²); there a misfit counts up to :data:`LARGEST_MISFIT`.
    """
    left, singular, _ = np.linalg.svd(factor[:, :-1] / math.sqrt(min(misfit, LARGEST_MISFIT)), full_matrices=False)
    along = left.T @ factor[:, -1] / math.sqrt(misfit)
    return math.sqrt(np.sum(along**2 * singular**2 / (1 + singular**2)))


def _hold(
    factor: Float[np.ndarray, "n+1 n+1"], y: np.ndarray, limits: tuple[np.ndarray, np.ndarray]
) -> Float[np.ndarray, "n+1 n+1"]:
    """``factor`` without the derivatives for coordinates that χ² pushes against their limits: no step moves them."""
    gradient = factor[:, :-1].T @ factor[:, -1]
    held = ((y <= limits[0]) & (gradient > 0)) | ((y >= limits[1]) & (gradient < 0))
    return np.where(np.append(held, False), 0, factor)


def _shorten(y: Coordinates, trial: Coordinates, limits: tuple[np.ndarray, np.ndarray]) -> Coordinates:
    """``trial``, pulled towards ``y`` until no coordinate changes by more than is sensible, and inside the limits."""
    largest = jnp.max(jnp.abs(trial - y))
    return jnp.clip(y + (trial - y) * jnp.minimum(1, LONGEST_STEP / jnp.where(largest > 0, largest, 1)), *limits)


class Point(NamedTuple):
    """A point of the search, and why the search ended if it ended there."""

    y: Coordinates
    linearisation: Linearisation
    triangle: Float[np.ndarray, "n+1 n+1"]
    chi2: float
    distance: float
    converged: bool = False
    message: str = OUT_OF_STEPS


def minimise(
    y: Coordinates,
    start: Linearisation,
    problem: Problem,
    *,
    evaluate: Callable[[Coordinates, Problem], Linearisation],
    tolerance: float,
    max_steps: int,
    history: list[Step],
    progress: Progress | None,
    keep: Callable[[Coordinates, float], None],
    step_size: float | None = None,
    patience: int | None = None,
) -> Point:
    """Levenberg-Marquardt from ``y``, where the model is linearised already, until ``history`` holds ``max_steps``.

    ``keep`` is given the best point and the step size after every step; ``step_size`` is that of the first one.
    After ``patience`` steps a search that has still gone astray ends.
    """
    begun = len(history)
    x, linear = problem.split(y)
    state = outermost(_start)(x)
    limits = jax.tree.map(np.asarray, problem.limits)
    freedom = max(_count(problem.batch) - y.size, 1)
    stage = history[-1].stage + 1 if history else 1
    best: Point | None = None
    misfit, scale, rejections = 1.0, 1.0, 0
    try:
        while best is None or len(history) < max_steps:
            started = time.perf_counter()
            trial = outermost(_shorten)(x, state.y_eval, limits)
            linearisation = start if best is None else evaluate(trial, problem)
            whole = eliminate(jnp.concatenate([trial, linear]), linearisation, problem)
            factor = np.asarray(outermost(reduce)(whole, linearisation, problem), dtype=np.float64)
            finite = bool(np.all(np.isfinite(factor)))
            if finite:
                chi2, held = (
                    float(np.sum(factor[:, -1] ** 2)),
                    _hold(profile(factor, linear.size), np.asarray(trial), limits),
                )
            else:
                # An infinitely bad point, in numbers whose squares do not overflow: the step is rejected and shortened.
                chi2, held = math.inf, np.diag([0.0] * x.size + [1e15])
            size = state.search_state.step_size
            if best is None:
                size = size if step_size is None else jnp.full_like(size, step_size)
                misfit = scale = max(1.0, chi2 / freedom)
            elif chi2 < best.chi2:
                # The damping follows the misfit: with λ = 1 a step is restrained to about a natural unit in directions
                # that the data, given residuals of the present size, determine no better than that.
                previous, misfit = misfit, max(1.0, chi2 / freedom)
                size = size * (previous / misfit)
            state = eqx.tree_at(lambda s: (s.y_eval, s.search_state.step_size), state, (trial, size))
            change = float(np.max(np.abs(np.asarray(trial) - np.asarray(x))))
            plane = jnp.asarray(held / math.sqrt(scale), dtype=x.dtype)
            x, state = outermost(_step)(x, state, (plane[:, -1], plane[:, :-1], trial))
            accepted = best is None or (finite and np.array_equal(x, trial))
            if best is None or accepted:
                best, linear = Point(whole, linearisation, factor, chi2, distance(held, misfit)), whole[x.size :]
            rejections = 0 if accepted else rejections + 1
            history.append(
                Step(
                    step=len(history),
                    stage=stage,
                    chi2=chi2,
                    reduced_chi2=chi2 / freedom,
                    accepted=accepted,
                    change=change,
                    distance=best.distance,
                    damping=scale / max(float(state.search_state.step_size), 1e-30),
                    seconds=time.perf_counter() - started,
                )
            )
            keep(best.y, float(state.search_state.step_size))
            if progress is not None:
                progress(history[-1])
            if np.array_equal(outermost(_shorten)(x, state.y_eval, limits), x):
                rejections = REJECTIONS_AT_MOST
            end = _end(best.distance, rejections, tolerance)
            if end is not None:
                return best._replace(converged=end[0], message=end[1])
            if patience is not None and len(history) - begun >= patience and best.chi2 > ASTRAY * freedom:
                break
    except KeyboardInterrupt:
        if best is None:
            raise
        return best._replace(message=INTERRUPTED)
    return best


def _elsewhere(
    problem: Problem,
    search: Callable[[Coordinates, Linearisation, Problem], Point],
    evaluate: Callable[[Coordinates, Problem], Linearisation],
) -> Iterator[Point]:
    """Where searches from other starts end, the most promising first."""
    dtype = problem.start.dtype
    for point in ranked(problem):
        x = jnp.asarray(np.append(point, np.zeros(problem.batch.nuisances.offsets)), dtype)
        start = evaluate(x, problem)
        y = jnp.append(x, jnp.asarray(starting(np.asarray(start.radiance), problem.batch), dtype))
        if np.isfinite(np.asarray(start.tangents)[np.asarray(problem.batch.used)]).all():
            yield search(y, start, problem)


def _apart(a: Point, b: Point, problem: Problem) -> float:
    """Standard errors between two minima."""
    misfit = min(a.chi2, b.chi2) / max(_count(problem.batch) - a.y.size, 1)
    return separation(np.asarray(a.y), np.asarray(b.y), (a.triangle, b.triangle), misfit)


def _distinct(points: Sequence[Point], problem: Problem) -> list[Point]:
    """The best of ``points``, then every other minimum that is a rival of it. An interrupted search interrupts the best."""
    best, *others = sorted(points, key=lambda point: point.chi2)
    kept = [best]
    for point in others:
        rival = point.converged and point.chi2 < RIVAL * best.chi2
        if rival and min(_apart(point, other, problem) for other in kept) > APART:
            kept.append(point)
    if any(point.message == INTERRUPTED for point in points):
        kept[0] = best._replace(converged=False, message=INTERRUPTED)
    return kept


def _shares(best: Point, problem: Problem) -> dict[str, Any]:
    """What the images contribute and what is known besides, and what a robust loss does."""
    shares: dict[str, Any] = {
        "of_images": best.triangle,
        "of_priors": np.zeros((0, best.y.size)),
        "inflation": None,
        "outliers": [0] * problem.batch.used.shape[0],
    }
    if problem.known:
        factor = outermost(reduce_images)(best.y, best.linearisation, problem)
        shares["of_images"] = np.asarray(factor, dtype=np.float64)
        shares["of_priors"] = np.asarray(outermost(prior_rows)(best.y, problem)[1], dtype=np.float64)
    if problem.loss is not None:
        off = outermost(whitened)(best.y, best.linearisation, problem)
        shares["inflation"] = float(problem.loss.inflation(off, problem.batch.used))
        weight = np.asarray(problem.loss(off)[0])
        shares["outliers"] = [int(n) for n in np.sum((weight < 0.5) & np.asarray(problem.batch.used), axis=1)]
    return shares


def _end(away: float, rejections: int, tolerance: float) -> tuple[bool, str] | None:
    """Whether the search has converged and how it ended; None while it has to go on."""
    if away < tolerance:
        return True, f"converged: {away:.2g} standard errors from the optimum"
    if rejections >= REJECTIONS_AT_ROUNDING and away < ROUNDING_DISTANCE:
        return True, f"converged as far as rounding allows: {away:.2g} standard errors from the optimum"
    if rejections >= REJECTIONS_AT_MOST:
        return False, f"stopped: no step improves the fit, {away:.2g} standard errors from where the optimum should be"
    return None


def _count(batch: Batch) -> int:
    """Number of residuals."""
    return int(np.sum(np.asarray(batch.used))) * batch.measured.shape[-1]


def _check_finite(start: Linearisation, batch: Batch, names: Sequence[str]) -> None:
    """Refuse start values at which the model or its derivatives are not finite where they are needed."""
    used = np.asarray(batch.used)
    for values, what in ((start.radiance, "radiance"), (start.tangents, "derivatives")):
        bad = used & ~np.isfinite(np.asarray(values)).all(axis=tuple(range(2, values.ndim)))
        for name, count in zip(names, bad.sum(axis=1), strict=True):
            if count:
                raise FitError(f"{name}: the model's {what} at the start: not finite in {count} of the pixels used")


def _check_weights(batch: Batch, names: Sequence[str]) -> None:
    """Refuse pixels whose noise single precision cannot square and divide by."""
    with np.errstate(all="ignore"):
        whitened = np.asarray(batch.measured / sigma(batch, batch.measured))
    bad = np.asarray(batch.used) & ~(np.isfinite(whitened) & (whitened < LARGEST_SIGNAL)).all(axis=-1)
    bad |= np.asarray(batch.used) & ((whitened == 0) & (np.asarray(batch.measured) != 0)).any(axis=-1)
    for name, count in zip(names, bad.sum(axis=1), strict=True):
        if count:
            raise FitError(
                f"{name}: signal and noise: {count} pixels are too bright, too dark or too exact for their numbers; expected a "
                f"noise between {1 / LARGEST_SIGNAL:g} and 1e18 times the signal, and signals from 1e-15 to 1e15"
            )


def _weigh(problem: Problem, light: Array) -> Problem:
    """``problem`` with the weights of pixels whose signal is ``light``."""
    weight = jnp.where(problem.batch.used[..., None], 1 / sigma(problem.batch, light), 0)
    return replace(problem, weight=weight)


def _rescaled(y: Coordinates, linearisation: Linearisation, problem: Problem) -> Problem:
    """``problem`` with the scale of its loss, if it has one, that of the residuals at ``y``."""
    if problem.loss is None:
        return problem
    found = scale(np.asarray(outermost(whitened)(y, linearisation, problem)), np.asarray(problem.batch.used))
    return replace(problem, loss=Loss(problem.loss.name, jnp.asarray(found, y.dtype)))


def restored(
    observations: Sequence[Observation],
    parameters: Parameters,
    y: Coordinates,
    *,
    priors: Sequence[Prior],
    loss: str | None,
    model: Model,
    refine: bool,
) -> tuple[Problem, Linearisation]:
    """The problem of which ``y`` is the solution, with noise, correction and scale of the loss as they are there."""
    batch = stack(observations, [float(nm) for nm in parameters.init.wavelengths])
    signal, shell = batch.measured, outermost(planet_shell)(model, parameters)
    problem = Problem(model, parameters, batch, signal, shell, jnp.ones_like(signal), collect(priors, parameters))
    if loss is not None:
        problem = replace(problem, loss=Loss(loss, jnp.ones((), signal.dtype)))
    start = outermost(linearise)(problem.split(y)[0], problem)
    if refine and (finer := model.finer()) is not None:
        correction = outermost(_correction)(problem.split(y)[0], problem, start.radiance, finer)
        problem = replace(problem, correction=correction)
        start = Linearisation(start.radiance * correction, start.tangents * correction[..., None])
    problem = outermost(_weigh)(problem, outermost(light)(y, start, problem))
    return _rescaled(y, start, problem), start


def solve(
    observations: Sequence[Observation],
    *,
    init: Atmosphere,
    free: Sequence[str],
    tie: Mapping[str, str] | None = None,
    priors: Sequence[Prior] = (),
    loss: str | None = None,
    model: Model,
    progress: Progress | None = None,
    max_steps: int = MAX_STEPS,
    tolerance: float = TOLERANCE,
    refine: bool = True,
    starts: int | None = None,
    checkpoint: Path | None = None,
) -> Solution:
    """Find the atmosphere that explains ``observations``; see :func:`fitting.fit`, which adds the error bars.

    A fit that does not converge returns the best point found, with ``converged`` False and a message. Raises
    :class:`FitError` for a fit that cannot be started.
    """
    if max_steps < 1:
        raise FitError(f"max_steps: got {max_steps}, expected at least 1")
    if starts is not None and starts < 1:
        raise FitError(f"starts: got {starts}, expected at least 1")
    if not tolerance > 0:
        raise FitError(f"tolerance: got {tolerance}, expected a number > 0")
    started = time.perf_counter()
    parameters = select(init, free, tie)
    # A checkpoint that does not belong here is found before anything is computed.
    saved, identity = None, ""
    if checkpoint is not None:
        identity = digest(list(observations), init, list(free), dict(tie or {}), list(priors), loss, model, refine)
        saved = load(checkpoint, identity)
    wavelengths = [float(nm) for nm in init.wavelengths]
    batch = stack(observations, wavelengths)
    labels, _ = gather(observations, wavelengths)
    size = parameters.size + batch.nuisances.size
    if _count(batch) < size:
        raise FitError(
            f"{_count(batch)} pixels and channels cannot determine {size} parameters; mask less or free less"
        )
    # Three programs, the longest first, compiled at the same time.
    _check_weights(batch, [observation.name for observation in observations])
    signal, of_planet = batch.measured, eqx.filter_eval_shape(planet_shell, model, parameters)
    problem = Problem(model, parameters, batch, signal, of_planet, jnp.ones_like(signal), collect(priors, parameters))
    if loss is not None:
        problem = replace(problem, loss=Loss(loss, jnp.ones((), signal.dtype)))
    compiling = [compile_ahead(linearise, problem.start, problem)]
    finer = model.finer() if refine else None
    if finer is not None:
        compiling.append(compile_ahead(_correction, problem.start, problem, signal, finer))
    problem = replace(problem, shell=outermost(planet_shell)(model, parameters))
    problem = outermost(_weigh)(problem, signal)
    compiling[0].join()
    seconds: list[float] = []

    def evaluate(x: Coordinates, problem: Problem) -> Linearisation:
        before = time.perf_counter()
        result = jax.block_until_ready(outermost(linearise)(x, problem))
        seconds.append(time.perf_counter() - before)
        return result

    x = problem.start if saved is None else jnp.asarray(saved.y[: problem.size], problem.start.dtype)
    start = evaluate(x, problem)
    _check_finite(start, batch, [observation.name for observation in observations])
    linear = starting(np.asarray(start.radiance), batch) if saved is None else saved.y[problem.size :]
    history = [Step(**row) for row in saved.history] if saved is not None else []
    final = saved is not None and saved.final

    def keep(y: Coordinates, step_size: float) -> None:
        nonlocal checkpoint
        if checkpoint is not None:
            try:
                rows = [step._asdict() for step in history]
                save(checkpoint, identity, Checkpoint(np.asarray(y), step_size, final, rows))
            except FitError as error:
                warnings.warn(f"{error}; the fit goes on without a checkpoint", stacklevel=2)
                checkpoint = None

    search = partial(minimise, evaluate=evaluate, max_steps=max_steps, history=history, progress=progress, keep=keep)
    # A broken-off fit goes on from the best point, not from one that was only tried.
    aside = partial(search, keep=lambda *_: None)
    rough = max(tolerance, FIRST_PASS_TOLERANCE)
    # A search that goes on has the step size that it had, any other begins with its own.
    step_size = None if saved is None else saved.step_size
    y, scales = jnp.concatenate([x, jnp.asarray(linear, x.dtype)]), [math.inf]
    interrupted, tried, first, rivals = False, 0, math.nan, list[Point]()
    astray = ASTRAY * max(_count(batch) - size, 1)
    while not final:
        problem = _rescaled(y, start, problem)
        patience = PATIENCE if starts is None and not tried else None
        best = search(y, start, problem, tolerance=rough, step_size=step_size, patience=patience)
        step_size = None
        wanted = 0 if tried else starts - 1 if starts is not None else OTHERS * (best.chi2 > astray)
        if wanted and best.message != INTERRUPTED and len(history) < max_steps:
            points, first = [best], best.chi2
            more = _elsewhere(
                problem, partial(aside, tolerance=rough, max_steps=len(history) + wanted * max_steps), evaluate
            )
            try:
                for point in islice(more, wanted):
                    again = _apart(point, min(points, key=lambda other: other.chi2), problem) < APART
                    points.append(point)
                    enough = starts is None and point.converged and (again or point.chi2 < astray)
                    if enough or point.message == INTERRUPTED:
                        break
            except KeyboardInterrupt:
                points[0] = best._replace(converged=False, message=INTERRUPTED)
            tried = len(points) - 1
            best, *rivals = _distinct(points, problem)
            search, aside = (partial(each, max_steps=len(history) + max_steps) for each in (search, aside))
        y, start = best.y, best.linearisation
        interrupted = best.message == INTERRUPTED
        if interrupted or problem.loss is None:
            break
        # While the fit gets better, fewer pixels pass for outliers.
        scales.append(float(problem.loss.scale))
        if scales[-1] == 1 or scales[-1] > SETTLED * scales[-2]:
            break
    if not interrupted:
        final = True
        problem = outermost(_weigh)(problem, outermost(light)(y, start, problem))
        problem = _rescaled(y, start, problem)
        best = search(y, start, problem, tolerance=tolerance, step_size=step_size)
        if best.message != INTERRUPTED:
            others = [aside(other.y, other.linearisation, problem, tolerance=tolerance) for other in rivals]
            best, *rivals = _distinct([best, *others], problem)
    minima = [(point.y, point.chi2) for point in (best, *rivals)] if rivals else []
    model_error = np.zeros((size, size))
    if finer is not None and best.converged:
        x, radiance = best.y[: problem.size], best.linearisation.radiance
        try:
            compiling[-1].join()
            correction = jax.block_until_ready(outermost(_correction)(x, problem, radiance, finer))
            problem = replace(problem, correction=correction)
            start = Linearisation(radiance * correction, best.linearisation.tangents * correction[..., None])
            best = search(best.y, start, problem, tolerance=tolerance)
            model_error = _model_error(best, problem)
            deviation = float(_deviation(problem).max())
            if best.converged and deviation > LARGEST_DEVIATION:
                best = best._replace(converged=False, message=TOO_COARSE.format(deviation))
        except KeyboardInterrupt:
            best = best._replace(converged=False, message=INTERRUPTED)
    misfit = float(np.sum(best.triangle[:, -1] ** 2)) / max(_count(batch) - size, 1)
    if best.converged and misfit > HOPELESS_MISFIT:
        best = best._replace(converged=False, message=UNLIKE.format(math.sqrt(misfit)))
    if best.converged and first > RIVAL * best.chi2:
        best = best._replace(message=ELSEWHERE.format(best.message, tried, first / best.chi2))
    total = time.perf_counter() - started
    # What a typical evaluation does not explain is compilation and preparation, which happen once.
    evaluations = min(total, len(seconds) * float(np.median(seconds)))
    return Solution(
        parameters=parameters,
        batch=batch,
        nuisances=labels,
        y=best.y,
        triangle=best.triangle,
        predicted=np.asarray(outermost(expected)(best.y, best.linearisation, problem)),
        model_error=model_error,
        history=history,
        residual_count=_count(batch),
        converged=best.converged,
        message=best.message,
        minima=minima,
        timings={"compile_s": total - evaluations, "solve_s": evaluations, "total_s": total},
        **_shares(best, problem),
    )
