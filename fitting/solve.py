"""The solution of a fit by Levenberg-Marquardt, without its error bars: which problem is solved when.

The search itself is :mod:`fitting.search`'s.

*Resolution.* The steps are those of the model as it is given. A model that knows a ``finer`` one of itself is then compared
with it at the optimum, and the last pass explains the images by the finer model there, with the slopes of the first and, where
it matters, how the comparison changes (:mod:`fitting.correction`). Where that moves the optimum, the comparison is made again.

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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
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
from fitting._errors import FitError
from fitting.batch import Batch, stack
from fitting.checkpoint import Checkpoint, digest, load, save
from fitting.correction import Correction
from fitting.devices import mesh_of
from fitting.elimination import starting
from fitting.evaluation import check_finite, corrected, evaluated, pose, rescaled, weighed
from fitting.least_squares import Factor, known_rows, reduce_images
from fitting.linearisation import Linearisation, linearise
from fitting.mixing import mixed
from fitting.nuisances import Label, gather
from fitting.observation import Observation
from fitting.parameters import Coordinates, Parameters, select
from fitting.priors import Prior
from fitting.problem import Linear, Predicted, Problem, expected, planet_shell, whitened
from fitting.search import ASTRAY, FIRST_PASS_TOLERANCE, INTERRUPTED, Point, Progress, Step, count, minimise
from fitting.starts import APART, RIVAL, ranked, separation

TOLERANCE = 0.1
"""Distance to the optimum, in standard errors, at which the fit has converged."""

MAX_STEPS = 100

LARGEST_SIGNAL = 1e9
"""Signal over noise, of a pixel, whose square can be summed in single precision."""

LARGEST_DEVIATION = 0.08
"""RMS of the correction, in any image, beyond which the model is too coarse for the atmosphere that was found."""

PATIENCE = 40
"""Steps after which a search with such a χ² is given up for others."""

OTHERS = 3
"""Starts that are tried then, at most: fewer if one leads to a better χ² than that, or to the same minimum again."""

CORRECTIONS, LEFT, LARGEST_RATE = 8, 0.5, 0.95
"""How often the finer model is asked at most, and how many standard errors the optimum may have left to go without asking it
again: in dense haze the model alone leads 75 of them astray, and its correction there is short by a quarter."""

GROWTH = 10.0
"""Relative growth of the correction along the way from the model's optimum to the finer one's, over the correction: 6 and more
in dense haze."""

FAR = 2.0
"""Distance, in standard errors, beyond which the slopes of a correction are made anew."""

HOPELESS_MISFIT = 1e4
"""Reduced χ² of images that have nothing to do with the model: another unit, another exposure."""

REWEIGHED, REWEIGHED_AT_MOST = 1.2, 5
"""Factor, in any image, between sigma and that of the light found, beyond which the fit goes on with that; how often."""

BALANCED, BALANCED_AT_MOST = 1.1, 4
"""Factor between the noise as the residuals show it and as it is taken to be, beyond which the fit goes on with the former, if
anything is known besides the images; how often."""

SETTLED = 0.9
"""Ratio of the scales of a robust loss, from one stage to the next, above which it does not fall any further."""

OF_FITTED_LIGHT = "with the noise of the fitted light"
"""Aim of a search."""

UNLIKE = (
    "the images are not of such a sky: residuals are {:.0f} times the noise; are exposure, units, camera and sun right?"
)
ELSEWHERE = "{}; from one of {} other starts, as the one given leads to a χ² {:.2g} times as large"
UNSETTLED = (
    "stopped: the noise, which depends on the light that is found, does not settle; are exposure and units right?"
)
TOO_COARSE = "converged, but the model's finer self differs from it by {:.0%}: the error bars do not hold"

RESTLESS = (
    "stopped: the model's finer self still moves the optimum by {:.1f} standard errors: the error bars do not hold"
)


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


class _Others(NamedTuple):
    """What other starts have led to: points near other minima, how many were tried, and χ² of what the given one led to."""

    rivals: Sequence[Coordinates | list[float]] = ()
    tried: int = 0
    given: float = math.nan


class _Found(NamedTuple):
    """The best point of a pass, other minima, and what the search from the given start led to if there were others."""

    best: Point
    rivals: list[Point]
    problem: Problem
    tried: int = 0
    given: float = math.nan

    @property
    def interrupted(self) -> bool:
        return self.best.message == INTERRUPTED


@dataclass
class _Run:
    """A fit on its way: what has been done, what is left to be spent, and where it is kept."""

    tolerance: float
    max_steps: int
    progress: Progress | None
    checkpoint: Path | None
    identity: str
    history: list[Step] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    final: bool = False
    """Whether sigma comes from the fitted signal."""
    understated: float = 1.0
    """Factor between the residuals and the noise, where that matters."""
    others: _Others = field(default_factory=_Others)
    step_size: float | None = None
    """That of a search that was broken off, for the one that goes on; any other begins with its own."""

    def evaluate(self, x: Coordinates, linear: Linear, problem: Problem) -> Linearisation:
        before = time.perf_counter()
        result = evaluated(x, linear, problem)
        self.seconds.append(time.perf_counter() - before)
        return result

    def begin(self, x: Coordinates, problem: Problem) -> tuple[Coordinates, Linearisation]:
        """``y`` with a start for the linear nuisances, and the linearisation there."""
        found = self.evaluate(x, jnp.zeros(problem.batch.nuisances.linear, x.dtype), problem)
        linear = array(starting(np.asarray(found.radiance), problem.batch), x.dtype)
        # Residuals of another exposure are differences of large numbers, and the weights of a robust loss are those of one.
        if np.any(np.abs(linear) > (0.1 if problem.loss is None else 0)):
            found = self.evaluate(x, linear, problem)
        return jnp.concatenate([x, linear]), found

    def search(
        self, y: Coordinates, problem: Problem, tolerance: float, *, aside: bool = False, steps: int = 0, **options: Any
    ) -> Point:
        """A search from ``y`` in up to ``steps`` more; one that is not ``aside`` is what a fit goes on from."""
        step_size, self.step_size = (None if aside else self.step_size), None
        return minimise(
            y,
            problem,
            evaluate=self.evaluate,
            tolerance=tolerance,
            max_steps=len(self.history) + steps if steps else self.max_steps,
            history=self.history,
            progress=self.progress,
            keep=(lambda *_: None) if aside else self.keep,
            step_size=step_size,
            **options,
        )

    def keep(self, y: Coordinates, step_size: float) -> None:
        """Write the best point to the checkpoint. Of several processes, which all come here with the same, one does."""
        if self.checkpoint is None or jax.process_index() > 0:
            return
        rows = [step._asdict() for step in self.history]
        rivals = [np.asarray(other).tolist() for other in self.others.rivals]
        state = (self.max_steps, self.final, self.understated, rivals, self.others.tried, self.others.given, rows)
        try:
            save(self.checkpoint, self.identity, Checkpoint(np.asarray(y), step_size, *state))
        except FitError as error:
            warnings.warn(f"{error}; the fit goes on without a checkpoint", stacklevel=2)
            self.checkpoint = None


def _first_pass(run: _Run, y: Coordinates, start: Linearisation, problem: Problem, starts: int | None) -> _Found:
    """The optimum with sigma from the measured signal, to one standard error, from here or from elsewhere.

    The scale of a robust loss follows the residuals: while the fit gets better, fewer pixels pass for outliers.
    """
    rough = max(run.tolerance, FIRST_PASS_TOLERANCE)
    known: Linearisation | None = start if problem.loss is None else None
    here, radiance, scales = y, start.radiance, [math.inf]
    found: _Found | None = None
    while True:
        problem = rescaled(here, radiance, problem)
        patience = PATIENCE if starts is None and found is None else None
        fallback = None if found is None else found.best
        best = run.search(y, problem, rough, start=known, patience=patience, fallback=fallback)
        if problem.batch.nuisances.pedestals:
            # The measured signal does not tell how much of it is light.
            best, problem = _reweighed(run, best, problem, rough)
        found = found._replace(best=best, problem=problem) if found else _rescued(run, best, problem, starts, rough)
        if found.interrupted or problem.loss is None:
            return found
        scales.append(float(problem.loss.scale))
        if scales[-1] == 1 or scales[-1] > SETTLED * scales[-2]:
            return found
        best, known = found.best, None
        here, y, radiance = best.y, best.onward, best.linearisation.radiance


def _rescued(run: _Run, best: Point, problem: Problem, starts: int | None, rough: float) -> _Found:
    """``best``, or what other starts lead to: as many as were asked for, or a few if it has gone astray."""
    astray = ASTRAY * max(count(problem.batch) - best.y.size, 1)
    wanted = starts - 1 if starts is not None else OTHERS * (best.chi2 > astray)
    if not wanted or best.message == INTERRUPTED or len(run.history) >= run.max_steps:
        return _Found(best, [], problem)
    points, each = [best], run.max_steps
    try:
        for point in islice(_elsewhere(run, problem, rough, wanted * each), wanted):
            again = _apart(point, min(points, key=lambda other: other.chi2), problem) < APART
            points.append(point)
            enough = starts is None and point.converged and (again or point.chi2 < astray)
            if enough or point.message == INTERRUPTED:
                break
    except KeyboardInterrupt:
        points[0] = best._replace(converged=False, message=INTERRUPTED)
    run.max_steps = len(run.history) + each
    first, *rivals = _distinct(points, problem)
    return _Found(first, rivals, problem, len(points) - 1, best.chi2)


def _elsewhere(run: _Run, problem: Problem, rough: float, steps: int) -> Iterator[Point]:
    """Where searches from other starts end, the most promising first, in up to so many steps together."""
    dtype, last = problem.start.dtype, len(run.history) + steps
    for point in ranked(problem):
        x = array(np.append(point, np.zeros(problem.batch.nuisances.offsets)), dtype)
        y, start = run.begin(x, problem)
        if not np.asarray(start.bad).any():
            left = last - len(run.history)
            yield run.search(y, problem, rough, aside=True, steps=left, start=start, aim="from another start")


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


def _final_pass(run: _Run, y: Coordinates, problem: Problem, before: _Found | None = None) -> _Found:
    """The optimum near ``y`` with sigma from the signal expected there, as ``problem`` has it, and the other minima.

    What was found ``before`` is left if it is interrupted at once.
    """
    run.final = True
    fallback, rivals = (None, []) if before is None else (before.best, before.rivals)
    best = run.search(y, problem, run.tolerance, fallback=fallback, aim=OF_FITTED_LIGHT)
    if best.message != INTERRUPTED:
        best, rivals = _among_others(run, best, problem)
    alone = problem
    best, problem = _reweighed(run, best, problem, run.tolerance)
    best, problem = _balanced(run, best, problem)
    if problem is not alone and best.message != INTERRUPTED:
        # Minima compare by the same noise.
        best, rivals = _among_others(run, best, problem)
    return _Found(best, rivals, problem, run.others.tried, run.others.given)


def _among_others(run: _Run, best: Point, problem: Problem) -> tuple[Point, list[Point]]:
    """The best of ``best`` and of the minima near those of ``run.others``, and its rivals, which are those from there on."""
    points = [array(other, best.y.dtype) for other in run.others.rivals]
    others = [
        run.search(point, problem, run.tolerance, aside=True, fallback=best, aim="the other minimum")
        for point in points
    ]
    best, *rivals = _distinct([best, *others], problem)
    run.others = run.others._replace(rivals=[rival.onward for rival in rivals])
    return best, rivals


def _reweighed(run: _Run, best: Point, problem: Problem, tolerance: float) -> tuple[Point, Problem]:
    """On from ``best`` while sigma is not that of the light there: that of a much brighter sky would hide any misfit."""
    for again in range(REWEIGHED_AT_MOST + 1):
        other = weighed(best.y, best.linearisation.radiance, problem)
        if not best.converged or _noisier(problem, other) <= REWEIGHED:
            break
        if again == REWEIGHED_AT_MOST:
            best = best._replace(converged=False, message=UNSETTLED)
            break
        problem = other
        best = run.search(best.onward, problem, tolerance, fallback=best, aim=OF_FITTED_LIGHT)
    return best, problem


def _balanced(run: _Run, best: Point, problem: Problem) -> tuple[Point, Problem]:
    """On from ``best`` while what is known besides is weighed against another noise than the residuals show.

    Where the noise is understated the images would overrule what is known, and by more than the error bars admit.
    """
    for _ in range(BALANCED_AT_MOST if problem.known else 0):
        found = _understated(best, problem)
        if not best.converged or abs(math.log(found / float(problem.understated))) < math.log(BALANCED):
            break
        run.understated = found
        problem = replace(problem, understated=array(found, best.y.dtype))
        best = run.search(best.onward, problem, run.tolerance, fallback=best, aim="what is known, beside such a noise")
    return best, problem


def _understated(best: Point, problem: Problem) -> float:
    """By what the error bars will be multiplied, as the residuals are so much larger than the stated noise."""
    if problem.loss is not None:
        off = outermost(whitened)(best.y, best.linearisation.radiance, problem)
        return max(1.0, math.sqrt(float(problem.loss.inflation(off, problem.batch.used))))
    chi2 = float(np.sum(reduce_images(best.y, best.linearisation, problem)[:, -1] ** 2))
    return max(1.0, math.sqrt(chi2 / max(count(problem.batch) - best.y.size, 1)))


def _noisier(a: Problem, b: Problem) -> float:
    """The typical factor, in the image where it is largest, by which sigma differs between ``a`` and ``b``."""
    used = np.asarray(a.batch.used)
    one, other = (np.asarray(problem.weight) for problem in (a, b))
    least = np.finfo(one.dtype).tiny
    off = np.log(np.maximum(one, least)) - np.log(np.maximum(other, least))
    of_pixels = np.abs(off, out=off).mean(axis=-1)
    return float(np.exp(max(np.mean(pixels[among]) for pixels, among in zip(of_pixels, used, strict=True))))


def _refined(run: _Run, found: _Found, finer: Model) -> tuple[_Found, Float[np.ndarray, "n n"]]:
    """The optimum if the images are explained by ``finer`` there, and the covariance of what that may leave of errors."""
    best, problem, alone = found.best, found.problem, found.problem
    here, linearisation, on = best.y, best.linearisation, best.onward
    slopes: tuple[Correction, np.ndarray] | None = None
    metric = best.triangle[:, :-1]
    places: list[np.ndarray] = []
    images: list[np.ndarray] = []
    try:
        way = math.inf
        for _ in range(CORRECTIONS):
            place = np.asarray(here, dtype=np.float64)
            if slopes is not None and np.linalg.norm(metric @ (place - slopes[1])) > FAR:
                slopes = None
            near = slopes[0] if slopes else None
            problem = corrected(here, linearisation, alone, finer, near=near, evaluate=run.evaluate)
            assert problem.correction is not None
            slopes = slopes or (problem.correction, place)
            best = run.search(on, problem, run.tolerance, aim="by the finer model")
            best, problem = _balanced(run, best, problem)
            alone = replace(alone, understated=problem.understated)
            places.append(place)
            images.append(np.asarray(best.y, dtype=np.float64))
            metric = best.triangle[:, :-1]
            moves = [np.linalg.norm(metric @ (led - place)) for place, led in zip(places, images, strict=True)]
            way = float(moves[-1])
            # Where the optimum goes if it is moved: at first by about what the correction grows along the way.
            rate = GROWTH * float(model_error.deviation(problem).max())
            if len(moves) > 1:
                apart = [np.linalg.norm(metric @ (both[-1] - both[-2])) for both in (images, places)]
                rate = float(apart[0] / apart[1])
            rate = min(rate, LARGEST_RATE)
            if not best.converged or way * rate / (1 - rate) < LEFT:
                break
            here = array(mixed(places, images, metric), best.y.dtype)
            x, linear = problem.split(here)
            here = jnp.concatenate([jnp.clip(x, *problem.limits), linear])
            linearisation = run.evaluate(*problem.split(here), alone)
            on = here
        else:
            best = best._replace(converged=False, message=RESTLESS.format(way))
    except KeyboardInterrupt:
        best = found.best._replace(converged=False, message=INTERRUPTED)
        return found._replace(best=best), np.zeros((best.y.size, best.y.size))
    deviation = float(model_error.deviation(problem).max())
    if best.converged and deviation > LARGEST_DEVIATION:
        best = best._replace(converged=False, message=TOO_COARSE.format(deviation))
    return found._replace(best=best, problem=problem), model_error.covariance(best, problem)


def _shares(best: Point, problem: Problem) -> dict[str, Any]:
    """What the images contribute and what is known besides, and what a robust loss does."""
    shares: dict[str, Any] = {
        "of_images": best.triangle,
        "of_priors": np.zeros((0, best.y.size)),
        "error_scale": _understated(best, problem),
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
    if max_steps < 1:
        raise FitError(f"max_steps: got {max_steps}, expected at least 1")
    if starts is not None and starts < 1:
        raise FitError(f"starts: got {starts}, expected at least 1")
    if not tolerance > 0:
        raise FitError(f"tolerance: got {tolerance}, expected a number > 0")
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
    run = _Run(tolerance, max_steps, progress, checkpoint, identity)
    if saved is None:
        y, start = run.begin(problem.start, problem)
    else:
        run.history += [Step(**row) for row in saved.history]
        run.final, run.understated, run.step_size = saved.final, saved.understated, saved.step_size
        run.max_steps = max(max_steps, saved.max_steps)
        run.others = _Others(saved.rivals, saved.tried, saved.given)
        y = array(saved.y, problem.start.dtype)
        start = run.evaluate(*problem.split(y), problem)
    check_finite(np.asarray(start.bad), names, "at the start")
    if run.final:
        problem = replace(weighed(y, start.radiance, problem), understated=array(run.understated, y.dtype))
        found = _final_pass(run, y, problem)
    else:
        found = _first_pass(run, y, start, problem, starts)
        # As large as the images are, and of no use any more.
        del start
        if not found.interrupted:
            run.others = _Others([rival.onward for rival in found.rivals], found.tried, found.given)
            best = found.best
            problem = weighed(best.y, best.linearisation.radiance, found.problem)
            found = _final_pass(run, best.onward, problem, found)
    minima = [(point.y, point.chi2) for point in (found.best, *found.rivals)] if found.rivals else []
    error, alone = np.zeros((size, size)), found.best
    if finer is not None and found.best.converged:
        for thread in compiling[2:]:
            thread.join()
        found, error = _refined(run, found, finer)
    best, problem = found.best, found.problem
    misfit = float(np.sum(best.triangle[:, -1] ** 2)) / max(count(batch) - size, 1)
    if best.converged and misfit > HOPELESS_MISFIT:
        best = best._replace(converged=False, message=UNLIKE.format(math.sqrt(misfit)))
    if best.converged and found.given > RIVAL * best.chi2:
        best = best._replace(message=ELSEWHERE.format(best.message, found.tried, found.given / best.chi2))
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
