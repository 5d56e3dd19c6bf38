"""A problem, posed and evaluated where it is computed, and its changes on the way to the solution."""

from collections.abc import Sequence
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
from fitting.correction import SLOPES, Correction
from fitting.devices import collected, gathered, placed
from fitting.least_squares import reduce
from fitting.linearisation import Linearisation, linearise
from fitting.observation import Observation, light_of
from fitting.parameters import Coordinates, Parameters
from fitting.priors import Prior, collect
from fitting.problem import Linear, Predicted, Problem, light, planet_shell, weights, whitened
from fitting.robust import Loss, scale
from fitting.smooth import Fields

FIELD_DEGREE = 3
"""Degree in direction up to which the model's errors are correlated."""

CHANGE = 3.0
"""Relative change of a correction over the change of the coordinate that causes it, in about: 1 to 5 in dense haze."""

LONGEST = 0.3
"""Of the steps along which it is measured, which else are error bars."""


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
    none = None if finer is None else Correction.constant(jnp.ones_like(signal), parameters.start)
    robust = None if loss is None else Loss(loss, jnp.ones((), signal.dtype))
    fields = Fields.of(batch, FIELD_DEGREE)
    weight = outermost(weights)(batch, array(measured_light(batch), signal.dtype))
    return Problem(model, parameters, batch, weight, shell, none, collect(priors, parameters), robust, fields)


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


def corrected(
    y: Coordinates, found: Linearisation, problem: Problem, finer: Model, near: Correction | None = None
) -> Problem:
    """``problem`` with the correction of its model by a finer one at ``y``, where ``found`` is the linearisation.

    How the correction changes is that of ``near``, if that is given.
    """
    coordinates = problem.parts(problem.split(y)[0])[0]
    ratio = _ratio(y, found.radiance, problem, finer)
    if near is not None:
        return replace(problem, correction=replace(near, ratio=ratio, at=coordinates))
    here = replace(problem, correction=Correction.constant(ratio, coordinates))
    for slot, (colour, step) in enumerate(_changing(y, found, here)):
        x = y[: problem.size].at[: problem.parameters.size].add(jnp.where(problem.colours()[0] == colour, step, 0))
        there = jnp.concatenate([x, y[problem.size :]])
        shifted = evaluated(x, y[problem.size :], problem)
        if np.asarray(shifted.bad).any():
            continue
        slope = jnp.log(_ratio(there, shifted.radiance, problem, finer) / ratio) / step
        old = here.correction
        assert old is not None
        new = replace(old, slope=old.slope.at[..., slot].set(slope), colour=old.colour.at[slot].set(colour))
        here = replace(here, correction=new)
    return here


def _ratio(y: Coordinates, radiance: Predicted, problem: Problem, finer: Model) -> Predicted:
    x, mesh = problem.split(y)[0], problem.batch.mesh
    found = outermost(model_error.ratio)(x, placed(problem), radiance, finer)
    return gathered(jax.block_until_ready(found), mesh)


def _changing(y: Coordinates, found: Linearisation, problem: Problem) -> list[tuple[int, float]]:
    """The tangents along which the correction changes by more than the noise within an error bar, and a step along each."""
    bars = model_error.standard_errors(reduce(y, found, problem))[: problem.parameters.size]
    assert problem.correction is not None
    added = np.asarray(outermost(light)(y, found.radiance, problem) * problem.weight, dtype=np.float64)
    added = added * (np.asarray(problem.correction.ratio, dtype=np.float64) - 1)
    colour, _ = problem.colours()
    largest = [float(bars[colour == number].max()) for number in range(colour.max() + 1)]
    size = CHANGE * float(np.linalg.norm(added))
    chosen = sorted((n for n, bar in enumerate(largest) if size * bar > 1), key=lambda n: -largest[n])[:SLOPES]
    _, upper = (np.asarray(limit)[: problem.parameters.size] for limit in problem.limits)
    steps = []
    for number in chosen:
        step = min(largest[number], LONGEST)
        own = colour == number
        room = np.all(np.asarray(y)[: problem.parameters.size][own] + step <= upper[own])
        steps.append((number, step if room else -step))
    return steps


def weighed(y: Coordinates, radiance: Predicted, problem: Problem) -> Problem:
    """``problem`` with the weights of the signal expected at ``y``, and the scale of its loss that of the residuals there."""
    lit = outermost(light)(y, radiance, problem)
    return rescaled(y, radiance, replace(problem, weight=outermost(weights)(problem.batch, lit)))


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
    found = evaluated(x, linear, problem)
    radiance = found.radiance
    if finer is not None:
        problem = corrected(y, found, problem, finer)
        assert problem.correction is not None
        radiance = radiance * problem.correction.ratio
    problem = weighed(y, radiance, problem)
    return problem, evaluated(x, linear, problem)
