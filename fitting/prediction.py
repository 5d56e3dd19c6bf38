"""A fitted atmosphere seen from elsewhere: the sky it predicts, and how well.

The radiance L of a scene is linear in the fitted numbers q as far as their error bars reach, so with the covariance C of the
fit, L has the covariance J C Jᵀ, J = dL/dq. It is not kept as a matrix of all pixels with all others but as a few *modes*: with
C = H Hᵀ the columns of J H are pictures, each of them one standard error of one of as many independent numbers. The variance of
a pixel is the sum of their squares; that of any sum over the picture is the sum of the squares of that sum over each mode.

J comes in forward mode. Wavelengths do not mix, so one tangent serves all wavelengths of a field. The radiance is that of the
model which explained the images of the fit, the finer one if there is one; J, as in the fit, that of the model itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo import render
from diffatmo.compiling import compile_ahead, outermost
from diffatmo.models import Model
from diffatmo.render import Scene
from fitting._errors import FitError
from fitting.findings import Estimate, Findings
from fitting.observation import Observation, sigma
from fitting.quantities import is_spectral, spectral_name

SINGULAR = 1e-12
"""Eigenvalues of a correlation matrix below this part of the largest are rounding: numbers that share one factor."""


@dataclass(frozen=True, repr=False)
class Prediction:
    """What a fit expects to see; arrays are NumPy's.

    ``radiance`` is in the units of a picture of ``scene``, which holds the fitted atmosphere: times the scene's exposure, and
    times the fitted exposure factor if one was asked for. A pixel is NaN in ``modes``, and so in ``standard_error``, if it
    depends on a number that the images of the fit did not determine: then its error bar is not known, not zero. Errors of the
    model enter as far as they moved the fitted numbers, and no further.
    """

    scene: Scene
    radiance: Float[np.ndarray, "height width w"]
    modes: Float[np.ndarray, "height width w mode"]

    @property
    def standard_error(self) -> Float[np.ndarray, "height width w"]:
        """Standard deviation of every pixel, from the covariance of the fit alone: without the noise of an image."""
        return np.sqrt(np.sum(self.modes**2, axis=-1))

    def pulls(self, observation: Observation) -> Float[np.ndarray, "height width w"]:
        """(measured - predicted) / √(noise² + standard error²) of an image that was not fitted; NaN where it is not used.

        Neighbours share the error of the prediction, so these numbers are of size one but not independent;
        :meth:`reduced_chi2` knows. Raises :class:`FitError` for an image of something else.
        """
        self._check(observation)
        used, pulls = observation.used, np.full_like(self.radiance, np.nan)
        expected = np.hypot(np.asarray(sigma(observation, self.radiance)), self.standard_error)
        pulls[used] = (observation.image - self.radiance)[used] / expected[used]
        return pulls

    def reduced_chi2(self, observation: Observation) -> float:
        """rᵀ (N + J C Jᵀ)⁻¹ r per number, with the noise N of an image that was not fitted and the residuals r of its pixels.

        1 on average if the image shows the fitted atmosphere and both error bars are right; NaN where the prediction has no
        error bar. Raises :class:`FitError` for an image of something else.
        """
        self._check(observation)
        used = observation.used
        noise = np.asarray(sigma(observation, self.radiance), dtype=float)[used].ravel()
        residual = (observation.image - self.radiance)[used].ravel() / noise
        modes = self.modes[used].reshape(noise.size, -1) / noise[:, None]
        # Woodbury: (1 + M Mᵀ)⁻¹ = 1 - M (1 + Mᵀ M)⁻¹ Mᵀ, with a matrix of modes by modes only.
        along = modes.T @ residual
        explained = along @ np.linalg.solve(np.eye(along.size) + modes.T @ modes, along)
        return float((residual @ residual - explained) / residual.size)

    def _check(self, observation: Observation) -> None:
        """Refuse an image of another scene."""
        if observation.image.shape != self.radiance.shape:
            binned = f" (averages of {observation.block} x {observation.block})" if observation.block > 1 else ""
            raise FitError(
                f"{observation.name}: has the shape {observation.image.shape}{binned}, the prediction {self.radiance.shape}"
            )
        scene = self.scene
        for what, own, predicted in (
            ("sun", observation.sun, scene.sun),
            ("altitude", observation.altitude, scene.altitude),
            ("exposure_value", observation.exposure_value, scene.exposure),
            ("camera", observation.directions, scene.camera.directions()),
        ):
            if not np.allclose(own, predicted, rtol=1e-5, atol=1e-5):
                raise FitError(f"{observation.name}: its {what} is not that of the prediction's scene")

    def __repr__(self) -> str:
        height, width, _ = self.radiance.shape
        bands = ", ".join(f"{nm:g}" for nm in np.asarray(self.scene.atmosphere.wavelengths))
        seen = self.radiance > 0
        relative = self.standard_error[seen] / self.radiance[seen]
        known = np.isfinite(relative)
        error = f"median standard error {100 * np.median(relative[known]):.2g} %" if known.any() else "no error bars"
        if not seen.any():
            error = "all of it dark"
        unknown = (
            f", {100 * np.mean(~known):.0f} % of the numbers without an error bar"
            if known.any() and not known.all()
            else ""
        )
        return f"Prediction: {width} x {height} pixels at {bands} nm, {error}{unknown}"


def predict(result: Findings, scene: Scene, *, model: Model | None = None, exposure: str | None = None) -> Prediction:
    """The fitted atmosphere in the place of the scene's own.

    Args:
        result: The fit.
        scene: Its camera, altitude, sun and exposure are used, its atmosphere is not, but must have the same wavelengths.
        model: How the sky is computed, by default as the fit did.
        exposure: Name of a fitted exposure factor that multiplies the picture, as it did the images of which it was found:
            ``exposure_camera``, without the wavelength where there is one for each.

    The picture, and about a dozen modes of its size, are held in memory. Raises :class:`FitError` for what is no scene or one
    with other wavelengths, an unknown exposure, or a fit by a model that is not known any more.
    """
    if not isinstance(scene, Scene):
        raise FitError(
            f"scene: got {type(scene).__name__}, expected a Scene: diffatmo.Scene(atmosphere, camera, altitude, sun)"
        )
    wavelengths = [float(nm) for nm in result.atmosphere.wavelengths]
    given = np.asarray(scene.atmosphere.wavelengths)
    if given.size != len(wavelengths) or not np.allclose(given, wavelengths):
        raise FitError(f"scene: has wavelengths {given.tolist()}, the fit {wavelengths}")
    factors = _factors(result, exposure, wavelengths)
    used = result.model if model is None else model
    if used is None:
        raise FitError("model: that of the fit is not one of diffatmo's own and was not saved with it; give model=")
    scene = replace(scene, atmosphere=result.atmosphere)
    fitted = [estimate for estimate in result.parameters if not estimate.derived]
    fields = tuple(dict.fromkeys(estimate.field for estimate in fitted))

    finer = used.finer() if result.refine and model is None else None
    compiling = compile_ahead(_value, scene, finer) if finer else None
    picture, slopes = (np.asarray(x, dtype=float) for x in outermost(_linearise)(scene, used, fields))
    if compiling:
        compiling.join()
        picture = np.asarray(outermost(_value)(scene, finer), dtype=float)
    radiance = picture * [factor.value if factor else 1.0 for factor in factors]
    modes = _modes(result, picture, slopes, fields, factors)
    return Prediction(scene=scene, radiance=radiance.astype(np.float32), modes=modes)


def _modes(
    result: Findings,
    picture: Float[np.ndarray, "height width w"],
    slopes: Float[np.ndarray, "height width w field"],
    fields: Sequence[str],
    factors: Sequence[Estimate | None],
) -> Float[np.ndarray, "height width w mode"]:
    """J H, channel by channel: only the numbers of its own wavelength and its exposure touch it."""
    names = [estimate.name for estimate in result.parameters if not estimate.derived]
    names += dict.fromkeys(factor.name for factor in factors if factor)
    index = [result.covariance_names.index(name) for name in names]
    half, determined = _half(result.covariance[np.ix_(index, index)])
    modes = np.empty((*picture.shape, half.shape[1]), dtype=np.float32)
    for channel, (nm, factor) in enumerate(zip(np.asarray(result.atmosphere.wavelengths), factors, strict=True)):
        touching = [spectral_name(field, nm) if is_spectral(field) else field for field in fields]
        slope = slopes[:, :, channel]
        if factor:
            touching.append(factor.name)
            slope = np.concatenate([factor.value * slope, picture[:, :, channel, None]], axis=-1)
        rows = [names.index(name) for name in touching]
        modes[:, :, channel] = slope @ half[rows]
        modes[np.any(slope[..., ~determined[rows]] != 0, axis=-1), channel] = np.nan
    return modes


def _factors(result: Findings, name: str | None, wavelengths: Sequence[float]) -> list[Estimate | None]:
    """For each channel the exposure factor that multiplies it, if any."""
    if name is None:
        return [None] * len(wavelengths)
    known = {estimate.name: estimate for estimate in result.nuisances if estimate.name.startswith("exposure_")}
    names = [name if name in known else spectral_name(name, nm) for nm in wavelengths]
    if not set(names) <= set(known):
        raise FitError(f"exposure: {name!r} is not a factor of this fit, which has {', '.join(known) or 'none'}")
    return [known[name] for name in names]


def _value(scene: Scene, model: Model) -> Float[Array, "height width w"]:
    return render.render(scene, model)


def _linearise(
    scene: Scene, model: Model, fields: tuple[str, ...]
) -> tuple[Float[Array, "height width w"], Float[Array, "height width w field"]]:
    """The picture, and its derivative in each field: in the number of that channel, if the field is a spectrum."""
    values = [getattr(scene.atmosphere, field) for field in fields]

    def picture(values: list[Array]) -> Array:
        air = eqx.tree_at(lambda a: [getattr(a, field) for field in fields], scene.atmosphere, values)
        return render.render(replace(scene, atmosphere=air), model)

    def along(seed: Float[Array, " field"]) -> tuple[Array, Array]:
        tangents = [jnp.full_like(value, share) for value, share in zip(values, seed, strict=True)]
        value, slope = jax.jvp(picture, (values,), (tangents,))
        return value, slope

    return jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(fields), dtype=values[0].dtype))


def _half(covariance: Float[np.ndarray, "q q"]) -> tuple[Float[np.ndarray, "q mode"], np.ndarray]:
    """H with C = H Hᵀ, and which numbers have a variance at all; the rows of the others are zero."""
    determined = np.isfinite(np.diag(covariance))
    known = np.where(np.outer(determined, determined), covariance, 0)
    deviation = np.sqrt(np.diag(known))
    scale = np.where(deviation > 0, deviation, 1)
    variance, axes = np.linalg.eigh(known / np.outer(scale, scale))
    kept = variance > SINGULAR * max(variance[-1], np.finfo(float).tiny)
    return scale[:, None] * axes[:, kept] * np.sqrt(variance[kept]), determined
