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
from fitting.devices import collected, gathered, placed
from fitting.linearisation import Linearisation, linearise
from fitting.observation import Observation, light_of
from fitting.parameters import Coordinates, Parameters
from fitting.priors import Prior, collect
from fitting.problem import Linear, Predicted, Problem, light, planet_shell, weights, whitened
from fitting.robust import Loss, scale
from fitting.smooth import Fields

FIELD_DEGREE = 3
"""Degree in direction up to which the model's errors are correlated."""


def pose(batch: Batch, parameters: Parameters, priors: Sequence[Prior], loss: str | None, model: Model) -> Problem:
    """The problem with weights from the measured signal; what is known of the planet is no more than its form yet."""
    signal, shell = batch.measured, eqx.filter_eval_shape(planet_shell, model, parameters)
    robust = None if loss is None else Loss(loss, jnp.ones((), signal.dtype))
    fields = Fields.of(batch, FIELD_DEGREE)
    weight = outermost(weights)(batch, array(measured_light(batch), signal.dtype))
    return Problem(
        model, parameters, batch, weight, shell, jnp.ones_like(signal), collect(priors, parameters), robust, fields
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


def corrected(y: Coordinates, radiance: Predicted, problem: Problem, finer: Model) -> Problem:
    """``problem`` with the correction of its model by a finer one at ``y``."""
    x, mesh = problem.split(y)[0], problem.batch.mesh
    found = outermost(model_error.correction)(x, placed(problem), radiance, finer)
    return replace(problem, correction=gathered(jax.block_until_ready(found), mesh))


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
    problem = pose(batch, parameters, priors, loss, model)
    problem = replace(problem, shell=outermost(planet_shell)(model, parameters))
    x, linear = problem.split(y)
    radiance = evaluated(x, linear, problem).radiance
    if refine and (finer := model.finer()) is not None:
        problem = corrected(y, radiance, problem, finer)
        assert problem.correction is not None
        radiance = radiance * problem.correction
    problem = weighed(y, radiance, problem)
    return problem, evaluated(x, linear, problem)
