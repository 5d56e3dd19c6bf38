"""A problem, posed and evaluated where it is computed, and its changes on the way to the solution."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from diffatmo.compiling import outermost
from diffatmo.models.base import Model
from diffatmo.numerics import array
from fitting import model_error
from fitting._errors import FitError
from fitting.batch import Batch, stack
from fitting.correction import DIRECTIONS, Correction
from fitting.devices import collected, gathered, placed
from fitting.elimination import RANK_TOLERANCE
from fitting.least_squares import reduce
from fitting.linearisation import Linearisation, linearise
from fitting.observation import Observation, light_of
from fitting.parameters import Coordinates, Parameters
from fitting.priors import Prior, collect
from fitting.problem import Linear, Predicted, Problem, light, limits_of, lit_weights, planet_shell, weights, whitened
from fitting.robust import Loss, scale
from fitting.smooth import Fields

FIELD_DEGREE = 3
"""Degree in direction up to which the model's errors are correlated."""

CHANGE = 3.0
"""Relative change of a correction over the change of the coordinates that causes it, in about: 1 to 5 in dense haze."""

NEGLIGIBLE = 0.5
"""Change of the light that is none, in units of the noise, in which a step of one standard error changes it by 1."""

SLIGHT = 0.05
"""Change of the light by a correction's, over that by the step, that is left out: so much it may do to an error bar."""

TRIED = 6
"""Directions that are looked at."""

LONGEST = 0.3
"""Of the steps along which the change is measured, which else are standard errors."""


def pose(
    batch: Batch,
    parameters: Parameters,
    priors: Sequence[Prior],
    loss: str | None,
    model: Model,
    finer: Model | None = None,
) -> Problem:
    """The problem with weights from the measured signal; what is known of the planet is no more than its form yet.

    With a ``finer`` model it has room for a correction, which is none yet.
    """
    signal, shell = batch.measured, eqx.filter_eval_shape(planet_shell, model, parameters)
    robust = None if loss is None else Loss(loss, jnp.ones((), signal.dtype))
    fields = Fields.of(batch, FIELD_DEGREE)
    weight = outermost(weights)(batch, signal if not batch.nuisances.pedestals else array(measured_light(batch)))
    known = collect(priors, parameters)
    problem = Problem(model, parameters, batch, weight, shell, priors=known, loss=robust, fields=fields)
    if finer is None:
        return problem
    return replace(
        problem, correction=Correction.constant(array(np.ones(signal.shape, signal.dtype), signal.dtype), problem.start)
    )


def measured_light(batch: Batch) -> Float[np.ndarray, "image pixel w"]:
    """The light in every pixel as far as the images alone tell: less a pedestal, where there may be one."""
    light, used = np.array(batch.measured), np.asarray(batch.used)
    for image, numbers in enumerate(np.asarray(batch.nuisances.pedestal_index)):
        if (numbers >= 0).any():
            light[image, used[image]] = light_of(light[image, used[image]])
    return light


def evaluated(x: Coordinates, linear: Linear, problem: Problem) -> Linearisation:
    """The linearisation at ``x``, computed."""
    mesh = problem.batch.mesh
    found = outermost(linearise)(x, linear, placed(problem))
    return collected(jax.block_until_ready(found), mesh)


def check_finite(bad: Int[np.ndarray, "image 2"], names: Sequence[str], where: str) -> None:
    """Refuse a point at which the model or its derivatives are not finite in so many of the pixels used."""
    for what, counts in zip(("radiance", "derivatives"), bad.T, strict=True):
        for name, lost in zip(names, counts, strict=True):
            if lost:
                raise FitError(f"{name}: the model's {what} {where}: not finite in {lost} of the pixels used")


Evaluate = Callable[[Coordinates, Linear, Problem], Linearisation]


def corrected(
    y: Coordinates,
    found: Linearisation,
    problem: Problem,
    finer: Model,
    *,
    near: Correction | None = None,
    evaluate: Evaluate = evaluated,
) -> Problem:
    """``problem`` with the correction of its model by a finer one at ``y``, where ``found`` is the linearisation.

    How the correction changes is that of ``near``, if that is given; if not, ``evaluate`` is asked a step away.
    """
    x, linear = problem.split(y)
    here = _ratio(x, found.radiance, problem, finer)
    ratio = array(np.where(np.isfinite(here), here, 1), here.dtype)
    if near is not None:
        return replace(problem, correction=replace(near, ratio=ratio, at=x))
    slopes = np.zeros((*here.shape, DIRECTIONS), here.dtype)
    along, place = np.zeros((DIRECTIONS, x.size)), 0
    added = _added(y, found.radiance, problem, np.asarray(ratio) - 1)
    for step, seen in _open_steps(y, found, problem)[:TRIED]:
        if place == DIRECTIONS or CHANGE * added * np.linalg.norm(step) < NEGLIGIBLE:
            break
        there = array(np.asarray(x, dtype=np.float64) + step, x.dtype)
        shifted = evaluate(there, linear, problem)
        slope = np.log(_ratio(there, shifted.radiance, problem, finer) / here)
        lost = np.isfinite(here) & ~np.isfinite(slope) & np.asarray(problem.batch.used)[..., None]
        if np.asarray(shifted.bad).any() or lost.any():
            continue
        slope = np.where(np.isfinite(slope), slope, 0)
        if _added(y, found.radiance, problem, slope) < SLIGHT * seen:
            continue
        slopes[..., place], along[place] = slope, step / (step @ step)
        place += 1
    return replace(problem, correction=Correction(ratio, x, array(slopes, here.dtype), array(along, x.dtype)))


def _ratio(x: Coordinates, radiance: Predicted, problem: Problem, finer: Model) -> Float[np.ndarray, "image pixel w"]:
    found = outermost(model_error.ratio)(x, placed(problem), radiance, finer)
    return np.asarray(gathered(jax.block_until_ready(found), problem.batch.mesh))


def _added(y: Coordinates, radiance: Predicted, problem: Problem, part: Float[np.ndarray, "image pixel w"]) -> float:
    """Such a part of the light, in units of the noise, over all pixels."""
    lit = np.asarray(outermost(light)(y, radiance, problem))
    return float(np.linalg.norm(np.asarray(lit * np.asarray(problem.weight) * part, dtype=np.float64)))


def _open_steps(y: Coordinates, found: Linearisation, problem: Problem) -> list[tuple[Float[np.ndarray, " x"], float]]:
    """Steps of a standard error in the directions that the images leave most open first, at right angles to each other, and
    what the images see of each in units of the noise: 1, but of a step that had to be shorter.

    Exposures and pedestals follow. A direction that is not determined at all is left to the model that says so.
    """
    triangle = reduce(y, found, problem)[:, :-1]
    of_x, of_linear = np.split(triangle, [problem.size], axis=1)
    if of_linear.size:
        of_x = of_x - of_linear @ np.linalg.lstsq(of_linear, of_x)[0]
    _, singular, directions = np.linalg.svd(of_x)
    lower, upper = (np.asarray(limit, dtype=np.float64) for limit in outermost(limits_of)(problem))
    x = np.asarray(y[: problem.size], dtype=np.float64)
    steps = []
    for value, direction in zip(singular[::-1], directions[::-1], strict=True):
        if value > RANK_TOLERANCE * singular[0]:
            # To the side where there is more room.
            room, towards = max((_room(x, side * direction, lower, upper), side) for side in (1, -1))
            length = min(1 / value, LONGEST, room)
            if length > 0:
                steps.append((towards * length * direction, float(value * length)))
    return steps


def _room(
    x: Float[np.ndarray, " x"],
    direction: Float[np.ndarray, " x"],
    lower: Float[np.ndarray, " x"],
    upper: Float[np.ndarray, " x"],
) -> float:
    """How far one can go from ``x`` before a coordinate reaches its limit."""
    moving = np.abs(direction) > 1e-6
    ends = np.where(direction > 0, upper - x, lower - x)[moving] / direction[moving]
    return float(max(np.min(ends, initial=np.inf), 0))


def weighed(y: Coordinates, radiance: Predicted, problem: Problem) -> Problem:
    """``problem`` with the weights of the signal expected at ``y``, and the scale of its loss that of the residuals there."""
    return rescaled(y, radiance, replace(problem, weight=outermost(lit_weights)(y, radiance, problem)))


def rescaled(y: Coordinates, radiance: Predicted, problem: Problem) -> Problem:
    """``problem`` with the scale of its loss, if it has one, that of the residuals at ``y``."""
    if problem.loss is None:
        return problem
    found = scale(np.asarray(outermost(whitened)(y, radiance, problem)), np.asarray(problem.batch.used))
    return replace(problem, loss=Loss(problem.loss.name, array(found, y.dtype)))


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
    finer = model.finer() if refine else None
    problem = pose(batch, parameters, priors, loss, model, finer)
    problem = replace(problem, shell=outermost(planet_shell)(model, parameters))
    x, linear = problem.split(y)
    problem = weighed(y, evaluated(x, linear, problem).radiance, problem)
    found = evaluated(x, linear, problem)
    if finer is not None:
        problem = corrected(y, found, problem, finer)
        assert problem.correction is not None
        problem = weighed(y, found.radiance * problem.correction.ratio, problem)
        found = evaluated(x, linear, problem)
    return problem, found
