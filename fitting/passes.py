"""The passes of a fit: searches of problems that differ in their noise, their start or the model.

The search itself is :mod:`fitting.search`'s.

*Noise.* sigma depends on the expected signal, which is known only after the fit. Taken from the noisy pixels it
favours those that came out dark, and biases the radiance by about -2 (relative noise)²: 2e-4 for 1 % noise, ten
standard errors of a well-determined parameter. So the fit starts with sigma from the measured signal, and goes on with that
from the fitted one.

*Starts.* A search that has gone astray, which its χ² shows, is begun anew from the best atmospheres of a coarse grid
(:mod:`fitting.starts`).

*Resolution.* The steps are those of the model as it is given. A model that knows a ``finer`` one of itself is then compared
with it at the optimum, and the last pass explains the images by the finer model there, with the slopes of the first and, where
it matters, how the comparison changes (:mod:`fitting.correction`). Where that moves the optimum, the comparison is made again.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffatmo.compiling import outermost
from diffatmo.models.base import Model
from diffatmo.numerics import array
from fitting import model_error
from fitting.checkpoint import Others
from fitting.correction import Correction
from fitting.evaluation import corrected, rescaled, weighed
from fitting.least_squares import reduce_images
from fitting.linearisation import Linearisation
from fitting.mixing import mixed
from fitting.parameters import Coordinates
from fitting.problem import Problem, limits_of, whitened
from fitting.run import Run
from fitting.search import ASTRAY, FIRST_PASS_TOLERANCE, INTERRUPTED, Point, count
from fitting.starts import APART, RIVAL, ranked, separation

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

LARGEST_DEVIATION = 0.08
"""RMS of the correction, in any image, beyond which the model is too coarse for the atmosphere that was found."""

REWEIGHED, REWEIGHED_AT_MOST = 1.2, 5
"""Factor, in any image, between sigma and that of the light found, beyond which the fit goes on with that; how often."""

BALANCED, BALANCED_AT_MOST = 1.1, 4
"""Factor between the noise as the residuals show it and as it is taken to be, beyond which the fit goes on with the former, if
anything is known besides the images; how often."""

SETTLED = 0.9
"""Ratio of the scales of a robust loss, from one stage to the next, above which it does not fall any further."""

OF_FITTED_LIGHT = "with the noise of the fitted light"
"""Aim of a search."""

UNSETTLED = (
    "stopped: the noise, which depends on the light that is found, does not settle; are exposure and units right?"
)

TOO_COARSE = "converged, but the model's finer self differs from it by {:.0%}: the error bars do not hold"

RESTLESS = (
    "stopped: the model's finer self still moves the optimum by {:.1f} standard errors: the error bars do not hold"
)


class Found(NamedTuple):
    """The best point of a pass, and other minima."""

    best: Point
    rivals: list[Point]
    problem: Problem

    @property
    def interrupted(self) -> bool:
        """Whether the user has ended it."""
        return self.best.message == INTERRUPTED


def first_pass(run: Run, y: Coordinates, start: Linearisation, problem: Problem, starts: int | None) -> Found:
    """The optimum with sigma from the measured signal, to one standard error, from here or from elsewhere.

    The scale of a robust loss follows the residuals: while the fit gets better, fewer pixels pass for outliers.
    """
    rough = max(run.tolerance, FIRST_PASS_TOLERANCE)
    known: Linearisation | None = start if problem.loss is None else None
    here, radiance, scales = y, start.radiance, [math.inf]
    found: Found | None = None
    while True:
        problem = rescaled(here, radiance, problem)
        impatient = starts is None and found is None and not run.others.tried
        # Of a run that was broken off, some steps are taken already.
        patience = max(1, PATIENCE - len(run.history)) if impatient else None
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


def final_pass(run: Run, y: Coordinates, problem: Problem, before: Found | None = None) -> Found:
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
    return Found(best, rivals, problem)


def refined(run: Run, found: Found, finer: Model) -> tuple[Found, Float[np.ndarray, "n n"]]:
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
            here = jnp.concatenate([jnp.clip(x, *outermost(limits_of)(problem)), linear])
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


def _rescued(run: Run, best: Point, problem: Problem, starts: int | None, rough: float) -> Found:
    """``best``, or what other starts lead to: as many as were asked for, or a few if it has gone astray."""
    astray = ASTRAY * max(count(problem.batch) - best.y.size, 1)
    # Of a run that was broken off, others may have begun.
    begun = bool(run.others.underway)
    wanted = starts - 1 if starts is not None else OTHERS * (begun or best.chi2 > astray)
    spent = len(run.history) >= run.max_steps and not begun
    if not wanted or run.others.tried or best.message == INTERRUPTED or spent:
        return Found(best, [], problem)
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
    if first.message != INTERRUPTED:
        run.others = Others(_onward(rivals), len(points) - 1, best.chi2)
    return Found(first, rivals, problem)


def _elsewhere(run: Run, problem: Problem, rough: float, steps: int) -> Iterator[Point]:
    """Where searches from other starts end, the most promising first, in up to so many steps together."""
    dtype, last = problem.start.dtype, len(run.history) + steps
    begun, number = run.others.underway, 0
    for point in ranked(problem):
        x = array(np.append(point, np.zeros(problem.batch.nuisances.offsets)), dtype)
        y, start = run.begin(x, problem)
        if np.asarray(start.bad).any():
            continue
        keep, left = partial(run.keep_aside, number), last - len(run.history)
        known: Linearisation | None = start
        if number < len(begun):
            y, known = array(begun[number], dtype), None
        number += 1
        yield run.search(y, problem, rough, keep=keep, steps=left, start=known, aim="from another start")


def _among_others(run: Run, best: Point, problem: Problem) -> tuple[Point, list[Point]]:
    """The best of ``best`` and of the minima near those of ``run.others``, and its rivals, which are those from there on."""
    points = [array(other, best.y.dtype) for other in run.others.rivals]
    others = [
        run.search(point, problem, run.tolerance, keep=lambda *_: None, fallback=best, aim="the other minimum")
        for point in points
    ]
    best, *rivals = _distinct([best, *others], problem)
    run.others = run.others._replace(rivals=_onward(rivals))
    return best, rivals


def _onward(points: Sequence[Point]) -> list[list[float]]:
    return [np.asarray(point.onward).tolist() for point in points]


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


def _apart(a: Point, b: Point, problem: Problem) -> float:
    """Standard errors between two minima."""
    misfit = min(a.chi2, b.chi2) / max(count(problem.batch) - a.y.size, 1)
    return separation(np.asarray(a.y), np.asarray(b.y), (a.triangle, b.triangle), misfit)


def _reweighed(run: Run, best: Point, problem: Problem, tolerance: float) -> tuple[Point, Problem]:
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


def _balanced(run: Run, best: Point, problem: Problem) -> tuple[Point, Problem]:
    """On from ``best`` while what is known besides is weighed against another noise than the residuals show.

    Where the noise is understated the images would overrule what is known, and by more than the error bars admit.
    """
    for _ in range(BALANCED_AT_MOST if problem.known else 0):
        found = understated(best, problem)
        if not best.converged or abs(math.log(found / float(problem.understated))) < math.log(BALANCED):
            break
        run.understated = found
        problem = replace(problem, understated=array(found, best.y.dtype))
        best = run.search(best.onward, problem, run.tolerance, fallback=best, aim="what is known, beside such a noise")
    return best, problem


def understated(best: Point, problem: Problem) -> float:
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
