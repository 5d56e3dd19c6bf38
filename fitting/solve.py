"""The solution of a fit by Levenberg-Marquardt, without its error bars: the problem is posed, and goes through the passes of
:mod:`fitting.passes`, or through what is left of them if the fit goes on from a checkpoint.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffatmo.atmosphere import Atmosphere
from diffatmo.compiling import compile_ahead, outermost
from diffatmo.models.base import Model
from diffatmo.numerics import array
from fitting import model_error
from fitting._errors import FitError, is_number
from fitting.batch import Batch, stack
from fitting.checkpoint import digest, load
from fitting.devices import mesh_of
from fitting.evaluation import check_finite, pose, weighed
from fitting.least_squares import Factor, known_rows, reduce_images
from fitting.linearisation import linearise
from fitting.nuisances import Label, gather
from fitting.observation import Observation
from fitting.parameters import Coordinates, Parameters, select
from fitting.passes import final_pass, first_pass, refined, understated
from fitting.priors import Prior
from fitting.problem import Predicted, Problem, expected, planet_shell, whitened
from fitting.run import Run
from fitting.search import Point, Progress, Step, count
from fitting.starts import RIVAL

TOLERANCE = 0.1
"""Distance to the optimum, in standard errors, at which the fit has converged."""

MAX_STEPS = 100

LARGEST_SIGNAL = 1e9
"""Signal over noise, of a pixel, whose square can be summed in single precision."""

HOPELESS_MISFIT = 1e4
"""Reduced χ² of images that have nothing to do with the model: another unit, another exposure."""

UNLIKE = (
    "the images are not of such a sky: residuals are {:.0f} times the noise; are exposure, units, camera and sun right?"
)

ELSEWHERE = "{}; from one of {} other starts, as the one given leads to a χ² {:.2g} times as large"


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
    """The derivatives of the residuals of what is known besides, in units of its own errors."""
    error_scale: float
    """By what the noise is understated, at least 1: √(reduced χ²), or what a robust loss makes of it."""
    outliers: list[int]
    """Pixels of each image to which a robust loss gives less than half their weight."""
    minima: list[tuple[Coordinates, float]]
    """Coordinates and χ² of the minima, the best first, if there are several; before any correction by a finer model."""
    moved: float
    """By how many of its standard errors a finer model has moved the number that it moved most."""

    @property
    def chi2(self) -> float:
        """Sum of the squared whitened residuals of the images, or of what a robust loss makes of them."""
        return float(np.sum(self.of_images[:, -1] ** 2))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of residuals less number of coordinates."""
        return self.residual_count - self.y.size


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
    if not isinstance(init, Atmosphere):
        raise FitError(f"init: got {init!r}, expected an Atmosphere, like diffatmo.earth()")
    if not isinstance(model, Model):
        raise FitError(f"model: got {model!r}, expected a model, like diffatmo.models.Moments()")
    for name, number in (("max_steps", max_steps), ("starts", 1 if starts is None else starts)):
        if not (isinstance(number, Integral) and number >= 1):
            raise FitError(f"{name}: got {number!r}, expected at least 1, and a whole number")
    if not (is_number(tolerance) and 0 < tolerance < math.inf):
        raise FitError(f"tolerance: got {tolerance!r}, expected a finite number > 0")
    if not isinstance(refine, bool):
        raise FitError(f"refine: got {refine!r}, expected True or False")
    if progress is not None and not callable(progress):
        raise FitError(f"progress: got {progress!r}, expected a function of a Step")
    began = time.perf_counter()
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
    finer = model.finer() if refine else None
    problem = pose(batch, parameters, priors, loss, model, finer)
    _check_weights(batch, problem.weight, names)
    compiling = _compile_ahead(problem, finer)
    for thread in compiling[:2]:
        thread.join()
    problem = replace(problem, shell=outermost(planet_shell)(model, parameters))
    run = Run(tolerance, max_steps, progress, checkpoint, identity)
    if saved is None:
        y, start = run.begin(problem.start, problem)
    else:
        run.history += [Step(**row) for row in saved.history]
        run.final, run.understated, run.step_size = saved.final, saved.understated, saved.step_size
        run.max_steps = max(max_steps, saved.max_steps)
        run.others = saved.others
        y = array(saved.y, problem.start.dtype)
        start = run.evaluate(*problem.split(y), problem)
    check_finite(np.asarray(start.bad), names, "at the start")
    if run.final:
        problem = replace(weighed(y, start.radiance, problem), understated=array(run.understated, y.dtype))
        found = final_pass(run, y, problem)
    else:
        found = first_pass(run, y, start, problem, starts)
        # As large as the images are, and of no use any more.
        del start
        if not found.interrupted:
            best = found.best
            problem = weighed(best.y, best.linearisation.radiance, found.problem)
            found = final_pass(run, best.onward, problem, found)
    minima = [(point.y, point.chi2) for point in (found.best, *found.rivals)] if found.rivals else []
    error, alone = np.zeros((size, size)), found.best
    if finer is not None and found.best.converged:
        for thread in compiling[2:]:
            thread.join()
        found, error = refined(run, found, finer)
    best, problem = found.best, found.problem
    misfit = float(np.sum(best.triangle[:, -1] ** 2)) / max(count(batch) - size, 1)
    if best.converged and misfit > HOPELESS_MISFIT:
        best = best._replace(converged=False, message=UNLIKE.format(math.sqrt(misfit)))
    tried, given = run.others.tried, run.others.given
    if best.converged and given > RIVAL * best.chi2:
        best = best._replace(message=ELSEWHERE.format(best.message, tried, given / best.chi2))
    total = time.perf_counter() - began
    # What a typical evaluation does not explain is compilation and preparation, which happen once.
    evaluations = min(total, len(run.seconds) * float(np.median(run.seconds)))
    return Solution(
        parameters=parameters,
        batch=batch,
        nuisances=labels,
        y=best.y,
        triangle=best.triangle,
        predicted=np.asarray(outermost(expected)(best.y, best.linearisation.radiance, problem)),
        model_error=error,
        history=run.history,
        residual_count=count(batch),
        converged=best.converged,
        message=best.message,
        minima=minima,
        moved=model_error.moved(alone, best, error, parameters.size),
        timings={"compile_s": total - evaluations, "solve_s": evaluations, "total_s": total},
        **_shares(best, problem),
    )


def _shares(best: Point, problem: Problem) -> dict[str, Any]:
    """What the images contribute and what is known besides, and what a robust loss does."""
    shares: dict[str, Any] = {
        "of_images": best.triangle,
        "of_priors": np.zeros((0, best.y.size)),
        "error_scale": understated(best, problem),
        "outliers": [0] * problem.batch.used.shape[0],
    }
    if problem.known:
        shares["of_images"] = reduce_images(best.y, best.linearisation, problem)
        shares["of_priors"] = known_rows(best.y, problem)[1] / float(problem.understated)
    if problem.loss is not None:
        off = outermost(whitened)(best.y, best.linearisation.radiance, problem)
        weight = np.asarray(problem.loss(off)[0])
        shares["outliers"] = [int(n) for n in np.sum((weight < 0.5) & np.asarray(problem.batch.used), axis=1)]
    return shares


def _check_weights(batch: Batch, weight: Predicted, names: Sequence[str]) -> None:
    """Refuse pixels whose noise single precision cannot square and divide by."""
    with np.errstate(all="ignore"):
        whitened = np.asarray(batch.measured) * np.asarray(weight)
    bad = np.asarray(batch.used) & ~(np.isfinite(whitened) & (whitened < LARGEST_SIGNAL)).all(axis=-1)
    bad |= np.asarray(batch.used) & ((whitened == 0) & (np.asarray(batch.measured) != 0)).any(axis=-1)
    for name, lost in zip(names, bad.sum(axis=1), strict=True):
        if lost:
            raise FitError(
                f"{name}: signal and noise: {lost} pixels are too bright, too dark or too exact for their numbers; expected a "
                f"noise between {1 / LARGEST_SIGNAL:g} and 1e18 times the signal, and signals from 1e-15 to 1e15"
            )


def _compile_ahead(problem: Problem, finer: Model | None) -> list[Thread]:
    """The programs of a fit, compiled while the next one is traced, in the order of use. Not those of several devices."""
    batch = problem.batch
    if batch.mesh is not None:
        return []
    linear = jnp.zeros(batch.nuisances.linear, problem.start.dtype)
    compiling = [
        compile_ahead(planet_shell, problem.model, problem.parameters),
        compile_ahead(linearise, problem.start, linear, problem),
    ]
    if finer is not None:
        compiling.append(compile_ahead(model_error.ratio, problem.start, problem, batch.measured, finer))
    return compiling
