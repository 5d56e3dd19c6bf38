"""Profile likelihood: how χ² grows when one number is held elsewhere and everything else is fitted again.

The covariance takes χ² for a parabola. Where it is none, near a bound or for a number that the images hardly determine, its
error bar is symmetric and wrong; the profile (Cox & Hinkley 1974, Theoretical Statistics, section 9.3) is right: the values at
which Δχ² < 1 are the 68 % interval, those with Δχ² < 3.84 the 95 % one, and either may be open.

A number is held by one more residual, (number - target) / ε, with ε a tenth of its standard error. Its part of χ² is left out,
and what counts is the number where the search ended, not the target: such a point is the least χ² for *its* value of it,
whatever ε. Each search begins where a line through the two before leads.

Noise, scale of a robust loss and correction by the finer model stay as they were at the optimum, so that χ² is one function.
Δχ² is given in the unit of the error bars: divided by the square of the factor by which these exceed what the stated noise
alone makes of them, which are the misfit and the errors of the model. Where χ² is a parabola, it is that of the standard error.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo._names import did_you_mean
from diffatmo.compiling import outermost
from diffatmo.numerics import array
from fitting._errors import FitError
from fitting.evaluation import evaluated, restored
from fitting.findings import Estimate, Profile
from fitting.least_squares import known_rows, reduce
from fitting.linearisation import Linearisation
from fitting.nuisances import assumed
from fitting.parameters import Coordinates, select
from fitting.priors import Prior, Priors, collect
from fitting.problem import Linear, Problem, limits_of, whitened
from fitting.quantities import numbers
from fitting.result import FitResult
from fitting.search import INTERRUPTED, minimise
from fitting.uncertainty import propagate

POINTS = 13
"""Values of the number, over three standard errors to either side."""

FEWEST_POINTS = 5

REACH = 3.0
"""Standard errors to either side."""

TIGHTNESS = 0.1
"""ε in standard errors."""

TOLERANCE = 0.05
"""Distance from the optimum at which a search ends, in standard errors; leaves Δχ² 0.0025 too large."""

STEPS = 40
"""Of each search."""

STUCK = 0.3
"""Part of a step below which a number that does not follow its target is at the end of its range."""

FAR = 16.0
"""Δχ² beyond which nothing is of interest."""


class _Optimum(NamedTuple):
    """The problem of which the result is the solution, and the model there."""

    problem: Problem
    y: Coordinates
    linearisation: Linearisation
    priors: list[Prior]
    scale: float
    """Factor between the residuals and the stated noise."""


class _Value(NamedTuple):
    """A point of the profile."""

    y: Coordinates
    number: float
    chi2: float
    settled: bool


def profile(
    result: FitResult, *names: str, points: int = POINTS, progress: Callable[[str, float, float], Any] | None = None
) -> FitResult:
    """``result`` with profiles of the numbers ``names`` in its ``profiles``; a spectral field stands for all of its numbers.

    ``points`` is the number of values, and ``progress`` is given each: the name, the value and Δχ². After an interrupt, the
    profiles that were finished are there. Raises :class:`FitError` for no name, one that is not a number of the atmosphere in
    the result, and for a result without what it takes to fit again.
    """
    if points < FEWEST_POINTS:
        raise FitError(f"points: got {points}, expected at least {FEWEST_POINTS}")
    if not names:
        raise FitError("profile: names: got none, expected numbers of the fit, like 'mie_g'")
    wanted = chosen(result.parameters, names)
    found = {each.name: each for each in result.profiles}
    try:
        optimum = _optimum(result)
        for estimate in wanted:
            found[estimate.name] = _profile(optimum, estimate, points // 2, progress)
    except KeyboardInterrupt:
        pass
    return replace(result, profiles=list(found.values()))


def chosen(estimates: list[Estimate], names: tuple[str, ...]) -> list[Estimate]:
    """Those of ``estimates`` that are called one of ``names``, or belong to a field that is. Raises :class:`FitError`."""
    wanted: list[Estimate] = []
    for name in names:
        meant = [e for e in estimates if e.name == name] or [e for e in estimates if e.field == name]
        if not meant:
            known = ", ".join(dict.fromkeys(e.field for e in estimates))
            hint = did_you_mean(name, [text for e in estimates for text in (e.field, e.name)]) or ";"
            raise FitError(
                f"profile: {name!r} is no number of this fit{hint} numbers are of {known}, with _<nm> for one wavelength"
            )
        wanted += [estimate for estimate in meant if estimate not in wanted]
    return wanted


def _optimum(result: FitResult) -> _Optimum:
    setup, model = result.setup, result.model
    if setup is None or model is None:
        raise FitError(
            "profile: the result does not know its start, free parameters and model; fit again with this version"
        )
    parameters = select(setup.init, setup.free, setup.tie)
    y = array(setup.coordinates, parameters.start.dtype)
    # What is known of the offsets is part of the problem already.
    offsets = {name for name, *_ in assumed(result.observations)}
    known = [prior for prior in result.priors if prior.name not in offsets]
    problem, linearisation = restored(
        result.observations, parameters, y, priors=known, loss=setup.loss, model=model, refine=result.refine
    )
    problem = replace(problem, understated=array(result.error_scale, y.dtype))
    return _Optimum(problem, y, linearisation, known, result.error_scale)


def _number(y: Coordinates, priors: Priors, problem: Problem) -> Float[Array, ""]:
    """The number that the last of ``priors`` is about."""
    return numbers(problem.parameters.atmosphere(problem.parts(problem.split(y)[0])[0]), priors.fields)[
        priors.index[-1]
    ]


def _gradient(y: Coordinates, priors: Priors, problem: Problem) -> Float[Array, " n"]:
    return jax.jacfwd(_number)(y, priors, problem)


def _held(optimum: _Optimum, name: str, target: float, error: float) -> Problem:
    """The problem in which the number ``name`` is held at ``target``."""
    known = [*optimum.priors, Prior(name, target, error)]
    return replace(optimum.problem, priors=collect(known, optimum.problem.parameters))


def _alone(optimum: _Optimum, name: str) -> float | None:
    """Standard error of a number by the noise as it turned out, without errors of the model; None if it has none."""
    free = replace(optimum.problem, priors=collect(optimum.priors, optimum.problem.parameters))
    factor = reduce(optimum.y, optimum.linearisation, free)[:-1, :-1]
    priors = _held(optimum, name, 0.0, 1.0).priors
    assert priors is not None
    gradient = np.asarray(outermost(_gradient)(optimum.y, priors, optimum.problem), dtype=np.float64)
    covariance, determined = propagate(factor / optimum.scale, gradient[None])
    return math.sqrt(covariance[0, 0]) if determined[0] and covariance[0, 0] > 0 else None


def _chi2(y: Coordinates, linearisation: Linearisation, problem: Problem) -> float:
    """That of the images and of the priors but for the last, in double precision as far as it is a sum of squares."""
    off = np.asarray(outermost(whitened)(y, linearisation.radiance, problem), dtype=np.float64)
    of_images = float(np.sum(off**2)) if problem.loss is None else float(problem.loss(jnp.asarray(off, y.dtype))[1])
    assert problem.priors is not None
    known = known_rows(y, problem)[0]
    # The offsets' come after the priors'.
    return of_images + float(np.sum(np.delete(known, problem.priors.value.size - 1) ** 2))


def _profile(
    optimum: _Optimum, estimate: Estimate, half: int, progress: Callable[[str, float, float], Any] | None
) -> Profile:
    name, error = estimate.name, estimate.standard_error
    alone = _alone(optimum, name)
    reach = REACH * error if error else max(abs(estimate.value), 1e-3)
    tight = TIGHTNESS * (alone or reach / REACH)
    # In single precision a number cannot be held more tightly than its own digits.
    tight = max(tight, 1e-6 * abs(estimate.value) * optimum.scale)
    unit = optimum.scale**2 * ((error / alone) ** 2 if error and alone else 1.0)
    problem = _held(optimum, name, estimate.value, tight)
    # The fit itself may end short of the optimum in directions that the images leave almost open.
    middle = _next([_valued(optimum.y, optimum.linearisation, problem, settled=True)], estimate.value, problem, optimum)
    sides: list[list[_Value]] = []
    bounded: list[bool] = []
    for sign in (-1, 1):
        walk, ended = [middle], False
        for number in range(1, half + 1):
            step = sign * reach / half
            value = _next(walk, estimate.value + number * step, problem, optimum)
            if abs(value.number - walk[-1].number) < STUCK * abs(step):
                ended = True
                break
            walk.append(value)
            growth = (value.chi2 - middle.chi2) / unit
            if progress is not None:
                progress(name, value.number, growth)
            if growth > FAR:
                break
        sides.append(walk[1:])
        bounded.append(ended)
    walk = [*reversed(sides[0]), middle, *sides[1]]
    least = min(value.chi2 for value in walk)
    return Profile(
        name=name,
        unit=estimate.unit,
        value=estimate.value,
        standard_error=error,
        points=np.array([value.number for value in walk]),
        delta_chi2=np.array([(value.chi2 - least) / unit for value in walk]),
        settled=np.array([value.settled for value in walk]),
        bounded=(bounded[0], bounded[1]),
    )


def _valued(y: Coordinates, linearisation: Linearisation, problem: Problem, *, settled: bool) -> _Value:
    assert problem.priors is not None
    number = float(outermost(_number)(y, problem.priors, problem))
    return _Value(y, number, _chi2(y, linearisation, problem), settled)


def _next(walk: list[_Value], target: float, problem: Problem, optimum: _Optimum) -> _Value:
    """The point of the profile with the number near ``target``, from those before it."""
    assert problem.priors is not None
    held = eqx.tree_at(lambda p: p.priors.value, problem, problem.priors.value.at[-1].set(target))
    y = walk[-1].y
    if len(walk) > 1:
        before = walk[-2]
        y = y + (y - before.y) * (target - walk[-1].number) / (walk[-1].number - before.number)
        x, linear = problem.split(y)
        y = jnp.concatenate([jnp.clip(x, *outermost(limits_of)(problem)), linear])

    def evaluate(x: Coordinates, linear: Linear, _: Problem) -> Linearisation:
        # The priors do not matter to the model, whose program of the fit is used again.
        return evaluated(x, linear, optimum.problem)

    start = evaluate(*problem.split(y), held)
    if np.asarray(start.bad).any():
        y = walk[-1].y
        start = evaluate(*problem.split(y), held)
    point = minimise(
        y,
        held,
        start=start,
        evaluate=evaluate,
        tolerance=TOLERANCE,
        max_steps=STEPS,
        history=[],
        progress=None,
        keep=lambda *_: None,
    )
    if point.message == INTERRUPTED:
        raise KeyboardInterrupt
    return _valued(point.y, point.linearisation, held, settled=point.converged)
