"""The solution of a fit by Levenberg-Marquardt, without its error bars: which problem is solved when.

The search itself is :mod:`fitting.search`'s.

*Resolution.* The steps are those of the model as it is given. A model that knows a ``finer`` one of itself is then compared
with it at the optimum, and the last pass explains the images by the finer model there, with the slopes of the first.

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
from jaxtyping import Float, Int

from diffatmo.atmosphere import Atmosphere
from diffatmo.compiling import compile_ahead, outermost
from diffatmo.models.base import Model
from fitting import model_error
from fitting._errors import FitError
from fitting.batch import Batch, stack
from fitting.checkpoint import Checkpoint, digest, load, save
from fitting.devices import collected, gathered, mesh_of, placed
from fitting.elimination import starting
from fitting.least_squares import Factor, known_rows, reduce_images
from fitting.linearisation import Linearisation, linearise
from fitting.nuisances import Label, gather
from fitting.observation import Observation, sigma
from fitting.parameters import Coordinates, Parameters, select
from fitting.priors import Prior, collect
from fitting.problem import Linear, Predicted, Problem, expected, light, planet_shell, weights, whitened
from fitting.robust import Loss, scale
from fitting.search import ASTRAY, INTERRUPTED, Point, Progress, Step, count, minimise
from fitting.smooth import Fields
from fitting.starts import APART, RIVAL, ranked, separation

TOLERANCE = 0.1
"""Distance to the optimum, in standard errors, at which the fit has converged."""

MAX_STEPS = 100

FIRST_PASS_TOLERANCE = 1.0
"""The first pass only has to find the sigma of the second: one standard error from its optimum is near enough."""

LARGEST_SIGNAL = 1e9
"""Signal over noise, of a pixel, whose square can be summed in single precision."""

LARGEST_DEVIATION = 0.03
"""RMS of the correction, in any image, beyond which the model is too coarse for the atmosphere that was found."""

PATIENCE = 40
"""Steps after which a search with such a χ² is given up for others."""

OTHERS = 3
"""Starts that are tried then, at most: fewer if one leads to a better χ² than that, or to the same minimum again."""

HOPELESS_MISFIT = 1e4
"""Reduced χ² of images that have nothing to do with the model: another unit, another exposure."""

FIELD_DEGREE = 3
"""Degree in direction up to which the model's errors are correlated."""

SETTLED = 0.9
"""Ratio of the scales of a robust loss, from one stage to the next, above which it does not fall any further."""

UNLIKE = (
    "the images are not of such a sky: residuals are {:.0f} times the noise; are exposure, units, camera and sun right?"
)
ELSEWHERE = "{}; from one of {} other starts, as the one given leads to a χ² {:.2g} times as large"
TOO_COARSE = "converged, but the model's finer self differs from it by {:.0%}: the error bars do not hold"


Begin = Callable[[Coordinates, Problem], tuple[Coordinates, Linearisation]]
"""From ``x`` to ``y``, with a start for the linear nuisances, and the linearisation there."""


class Solution(NamedTuple):
    """The best point found and the linear model around it."""

    parameters: Parameters
    batch: Batch
    nuisances: list[Label]
    y: Coordinates
    triangle: Factor
    predicted: Float[np.ndarray, "image pixel w"]
    model_error: Float[np.ndarray, "n n"]
    """Covariance of ``y`` from errors of the model, as far as they are known."""
    history: list[Step]
    residual_count: int
    converged: bool
    message: str
    timings: dict[str, float]
    of_images: Factor
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


def pose(batch: Batch, parameters: Parameters, priors: Sequence[Prior], loss: str | None, model: Model) -> Problem:
    """The problem with weights from the measured signal; what is known of the planet is no more than its form yet."""
    signal, shell = batch.measured, eqx.filter_eval_shape(planet_shell, model, parameters)
    robust = None if loss is None else Loss(loss, jnp.ones((), signal.dtype))
    fields = Fields.of(batch, FIELD_DEGREE)
    weight = outermost(weights)(batch, signal)
    return Problem(
        model, parameters, batch, weight, shell, jnp.ones_like(signal), collect(priors, parameters), robust, fields
    )


def evaluated(x: Coordinates, linear: Linear, problem: Problem) -> Linearisation:
    """The linearisation at ``x``, computed."""
    mesh = problem.batch.mesh
    found = outermost(linearise)(x, linear, placed(problem))
    return collected(jax.block_until_ready(found), mesh)


def _corrected(y: Coordinates, radiance: Predicted, problem: Problem, finer: Model) -> Problem:
    """``problem`` with the correction of its model by a finer one at ``y``."""
    x, mesh = problem.split(y)[0], problem.batch.mesh
    found = outermost(model_error.correction)(x, placed(problem), radiance, finer)
    return replace(problem, correction=gathered(jax.block_until_ready(found), mesh))


def _weighed(y: Coordinates, radiance: Predicted, problem: Problem) -> Problem:
    """``problem`` with the weights of the signal expected at ``y``, and the scale of its loss that of the residuals there."""
    lit = outermost(light)(y, radiance, problem)
    return _rescaled(y, radiance, replace(problem, weight=outermost(weights)(problem.batch, lit)))


def _rescaled(y: Coordinates, radiance: Predicted, problem: Problem) -> Problem:
    """``problem`` with the scale of its loss, if it has one, that of the residuals at ``y``."""
    if problem.loss is None:
        return problem
    found = scale(np.asarray(outermost(whitened)(y, radiance, problem)), np.asarray(problem.batch.used))
    return replace(problem, loss=Loss(problem.loss.name, jnp.asarray(found, y.dtype)))


def _elsewhere(problem: Problem, search: Callable[..., Point], begin: Begin) -> Iterator[Point]:
    """Where searches from other starts end, the most promising first."""
    dtype = problem.start.dtype
    for point in ranked(problem):
        y, start = begin(jnp.asarray(np.append(point, np.zeros(problem.batch.nuisances.offsets)), dtype), problem)
        if not np.asarray(start.bad).any():
            yield search(y, problem, start=start)


def _apart(a: Point, b: Point, problem: Problem) -> float:
    """Standard errors between two minima."""
    misfit = min(a.chi2, b.chi2) / max(count(problem.batch) - a.y.size, 1)
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
        shares["of_images"] = reduce_images(best.y, best.linearisation, problem)
        shares["of_priors"] = known_rows(best.y, problem)[1]
    if problem.loss is not None:
        off = outermost(whitened)(best.y, best.linearisation.radiance, problem)
        shares["inflation"] = float(problem.loss.inflation(off, problem.batch.used))
        weight = np.asarray(problem.loss(off)[0])
        shares["outliers"] = [int(n) for n in np.sum((weight < 0.5) & np.asarray(problem.batch.used), axis=1)]
    return shares


def _check_finite(bad: Int[np.ndarray, "image 2"], names: Sequence[str]) -> None:
    """Refuse start values at which the model or its derivatives are not finite where they are needed."""
    for what, counts in zip(("radiance", "derivatives"), bad.T, strict=True):
        for name, lost in zip(names, counts, strict=True):
            if lost:
                raise FitError(f"{name}: the model's {what} at the start: not finite in {lost} of the pixels used")


def _check_weights(batch: Batch, names: Sequence[str]) -> None:
    """Refuse pixels whose noise single precision cannot square and divide by."""
    with np.errstate(all="ignore"):
        whitened = np.asarray(batch.measured / sigma(batch, batch.measured))
    bad = np.asarray(batch.used) & ~(np.isfinite(whitened) & (whitened < LARGEST_SIGNAL)).all(axis=-1)
    bad |= np.asarray(batch.used) & ((whitened == 0) & (np.asarray(batch.measured) != 0)).any(axis=-1)
    for name, lost in zip(names, bad.sum(axis=1), strict=True):
        if lost:
            raise FitError(
                f"{name}: signal and noise: {lost} pixels are too bright, too dark or too exact for their numbers; expected a "
                f"noise between {1 / LARGEST_SIGNAL:g} and 1e18 times the signal, and signals from 1e-15 to 1e15"
            )


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
    problem = pose(batch, parameters, priors, loss, model)
    problem = replace(problem, shell=outermost(planet_shell)(model, parameters))
    x, linear = problem.split(y)
    radiance = evaluated(x, linear, problem).radiance
    if refine and (finer := model.finer()) is not None:
        problem = _corrected(y, radiance, problem, finer)
        assert problem.correction is not None
        radiance = radiance * problem.correction
    problem = _weighed(y, radiance, problem)
    return problem, evaluated(x, linear, problem)


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
    devices: Sequence[jax.Device] | None = None,
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
    batch = stack(observations, wavelengths, mesh_of(devices))
    names = [observation.name for observation in observations]
    labels, _ = gather(observations, wavelengths)
    size = parameters.size + batch.nuisances.size
    if count(batch) < size:
        raise FitError(f"{count(batch)} pixels and channels cannot determine {size} parameters; mask less or free less")
    _check_weights(batch, names)
    problem = pose(batch, parameters, priors, loss, model)
    unknown = jnp.zeros(batch.nuisances.linear, problem.start.dtype)
    finer = model.finer() if refine else None
    compiling = []
    if batch.mesh is None:
        # The longest first, at the same time.
        compiling.append(compile_ahead(linearise, problem.start, unknown, problem))
        if finer is not None:
            compiling.append(compile_ahead(model_error.correction, problem.start, problem, batch.measured, finer))
    problem = replace(problem, shell=outermost(planet_shell)(model, parameters))
    for thread in compiling[:1]:
        thread.join()
    seconds: list[float] = []

    def evaluate(x: Coordinates, linear: Linear, problem: Problem) -> Linearisation:
        before = time.perf_counter()
        result = evaluated(x, linear, problem)
        seconds.append(time.perf_counter() - before)
        return result

    def begin(x: Coordinates, problem: Problem) -> tuple[Coordinates, Linearisation]:
        found = evaluate(x, unknown, problem)
        linear = jnp.asarray(starting(np.asarray(found.radiance), batch), x.dtype)
        # Residuals of another exposure are differences of large numbers, and the weights of a robust loss are those of one.
        if np.any(np.abs(linear) > (0.1 if problem.loss is None else 0)):
            found = evaluate(x, linear, problem)
        return jnp.concatenate([x, linear]), found

    if saved is None:
        y, start = begin(problem.start, problem)
    else:
        y = jnp.asarray(saved.y, problem.start.dtype)
        start = evaluate(*problem.split(y), problem)
    _check_finite(np.asarray(start.bad), names)
    history = [Step(**row) for row in saved.history] if saved is not None else []
    final = saved is not None and saved.final

    def keep(y: Coordinates, step_size: float) -> None:
        nonlocal checkpoint
        # Of several processes, which all come here with the same, one writes.
        if checkpoint is not None and jax.process_index() == 0:
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
    radiance, here, scales = start.radiance, y, [math.inf]
    best: Point | None = None
    interrupted, tried, first, rivals = False, 0, math.nan, list[Point]()
    astray = ASTRAY * max(count(batch) - size, 1)
    while not final:
        problem = _rescaled(here, radiance, problem)
        # Rows with the weights of a loss are of no use at another scale of it.
        known = start if best is None and problem.loss is None else None
        patience = PATIENCE if starts is None and not tried else None
        best = search(y, problem, start=known, tolerance=rough, step_size=step_size, patience=patience, fallback=best)
        step_size = None
        wanted = 0 if tried else starts - 1 if starts is not None else OTHERS * (best.chi2 > astray)
        if wanted and best.message != INTERRUPTED and len(history) < max_steps:
            points, first = [best], best.chi2
            more = _elsewhere(
                problem, partial(aside, tolerance=rough, max_steps=len(history) + wanted * max_steps), begin
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
        here, y, radiance = best.y, best.onward, best.linearisation.radiance
        interrupted = best.message == INTERRUPTED
        if interrupted or problem.loss is None:
            break
        # While the fit gets better, fewer pixels pass for outliers.
        scales.append(float(problem.loss.scale))
        if scales[-1] == 1 or scales[-1] > SETTLED * scales[-2]:
            break
    if not interrupted:
        final = True
        problem = _weighed(here, radiance, problem)
        best = search(y, problem, tolerance=tolerance, step_size=step_size, fallback=best)
        if best.message != INTERRUPTED:
            others = [aside(other.onward, problem, tolerance=tolerance, fallback=other) for other in rivals]
            best, *rivals = _distinct([best, *others], problem)
    assert best is not None
    minima = [(point.y, point.chi2) for point in (best, *rivals)] if rivals else []
    error = np.zeros((size, size))
    if finer is not None and best.converged:
        try:
            for thread in compiling[1:]:
                thread.join()
            corrected = _corrected(best.y, best.linearisation.radiance, problem, finer)
            better = search(best.onward, corrected, tolerance=tolerance)
            problem, best = corrected, better
            error = model_error.covariance(best, problem)
            deviation = float(model_error.deviation(problem).max())
            if best.converged and deviation > LARGEST_DEVIATION:
                best = best._replace(converged=False, message=TOO_COARSE.format(deviation))
        except KeyboardInterrupt:
            best = best._replace(converged=False, message=INTERRUPTED)
    misfit = float(np.sum(best.triangle[:, -1] ** 2)) / max(count(batch) - size, 1)
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
        predicted=np.asarray(outermost(expected)(best.y, best.linearisation.radiance, problem)),
        model_error=error,
        history=history,
        residual_count=count(batch),
        converged=best.converged,
        message=best.message,
        minima=minima,
        timings={"compile_s": total - evaluations, "solve_s": evaluations, "total_s": total},
        **_shares(best, problem),
    )
