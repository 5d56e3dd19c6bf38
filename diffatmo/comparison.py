"""The same sky by several models: how far each is from one taken for the truth, and what it costs."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from diffatmo import geometry
from diffatmo.compiling import outermost
from diffatmo.models import Model, PathTrace, Sky
from diffatmo.render import Scene

Picture = Float[np.ndarray, "height width w"]
Mask = Bool[np.ndarray, "height width"]

HORIZON_DEG = 5.0
"""Height of the band above the horizon that is looked at on its own."""

SUN_DEG = 3.0
"""Distance to the sun below which the sky is left out: no table resolves the aureole."""

DARK = 1e-5
"""Pixels darker than this part of the brightest are left out: of the unlit, a relative error says nothing."""

UNLIT = 1e-12
"""So are those darker than this part of the solar irradiance per steradian: there is more light from other stars."""

REPEATS = 3


class Outcome(NamedTuple):
    """A picture of a scene by one model, 0 outside a fisheye's circle, and its price on this machine."""

    picture: Picture
    stderr: Picture | None
    """Of the path tracer."""
    compile_s: float
    """First call less a later one, of both programs."""
    prepare_s: float
    """What does not depend on where one looks: tables, moments."""
    image_s: float
    """All pixels, once prepared."""


class Errors(NamedTuple):
    """Relative differences to the truth, over pixels and wavelengths, weighted by solid angle; NaN where nothing is seen."""

    rms: float
    mean: float
    largest: float
    horizon: float
    """RMS over the lowest ``HORIZON_DEG`` of the sky."""
    ground: float
    """RMS below the horizon."""
    noise: float
    """RMS standard error over the sky, of the model's own picture and of the truth's; 0 unless one of them is a Monte Carlo."""


def _timed(function: Callable[..., Any], *arguments: Any, repeats: int) -> tuple[Any, float, float]:
    """The result, seconds of the first call beyond those of a later one, and the least of the later ones."""
    seconds, result = [], None
    for _ in range(1 + repeats):
        start = time.perf_counter()
        result = jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    least = min(seconds[1:])
    return result, max(seconds[0] - least, 0.0), least


def _prepare(model: Model, scene: Scene) -> Sky:
    return model.sky(scene.atmosphere)


def _look(sky: Sky, scene: Scene) -> jax.Array:
    light = sky.view(altitude=scene.altitude, sun=scene.sun).radiance(view=scene.camera.directions()).radiance
    return jnp.where(scene.camera.valid()[..., None], light, 0)


def run(scene: Scene, model: Model) -> Outcome:
    """Render ``scene`` with ``model``, exposure left out; the path tracer traces every pixel once and is not timed twice."""
    if isinstance(model, PathTrace):
        start = time.perf_counter()
        sky = jax.block_until_ready(model.sky(scene.atmosphere))
        prepared = time.perf_counter()
        view = scene.camera.directions()
        light, error, _ = jax.block_until_ready(
            sky.radiance_with_error(altitude=scene.altitude, view=view, sun=scene.sun)
        )
        traced = time.perf_counter()
        light, error = (np.where(scene.camera.valid()[..., None], x, 0) for x in (light, error))
        return Outcome(light, error, 0.0, prepared - start, traced - prepared)
    solved, compiled, prepare_s = _timed(outermost(_prepare), model, scene, repeats=REPEATS)
    picture, also_compiled, image_s = _timed(outermost(_look), solved, scene, repeats=REPEATS)
    return Outcome(np.asarray(picture), None, compiled + also_compiled, prepare_s, image_s)


def regions(scene: Scene) -> dict[str, Mask]:
    """Which pixels are "sky", "horizon" (its lowest part) and "ground"; the sun's neighbourhood is in none of the first two."""
    view, valid = np.asarray(scene.camera.directions()), np.asarray(scene.camera.valid())
    horizon = float(geometry.horizon_mu(scene.altitude, scene.atmosphere.bottom_radius))
    elevation = np.degrees(np.arcsin(np.clip(view[..., 2], -1, 1)) - np.arcsin(horizon))
    away = view @ np.asarray(scene.sun) < np.cos(np.radians(SUN_DEG))
    sky = valid & (elevation > 0) & away
    return {"sky": sky, "horizon": sky & (elevation < HORIZON_DEG), "ground": valid & (elevation <= 0)}


def relative(scene: Scene, outcome: Outcome, truth: Outcome) -> Picture:
    """Signed relative difference to the truth; NaN where that is dark."""
    unlit = UNLIT * np.asarray(scene.atmosphere.solar_irradiance)
    seen = truth.picture > np.maximum(unlit, DARK * truth.picture.max())
    return np.where(seen, outcome.picture / np.where(seen, truth.picture, 1) - 1, np.nan)


def errors(scene: Scene, outcome: Outcome, truth: Outcome) -> Errors:
    """How far ``outcome`` is from ``truth``."""
    off, masks = relative(scene, outcome, truth), regions(scene)
    weights = np.broadcast_to(np.asarray(scene.camera.solid_angles())[..., None], off.shape)

    def average(values: Picture, mask: Mask) -> float:
        chosen = mask[..., None] & np.isfinite(off)
        total = weights[chosen].sum()
        return float((weights[chosen] * values[chosen]).sum() / total) if total > 0 else float("nan")

    def rms(mask: Mask) -> float:
        return float(np.sqrt(average(off**2, mask)))

    sky = masks["sky"]
    chosen = np.abs(off[sky][np.isfinite(off[sky])])
    seen = np.where(np.isfinite(off), truth.picture, 1)
    noise = sum(
        average((o.stderr / seen) ** 2, sky)
        for o in {id(o): o for o in (outcome, truth)}.values()
        if o.stderr is not None
    )
    largest = float(chosen.max()) if chosen.size else float("nan")
    return Errors(
        rms(sky), average(off, sky), largest, rms(masks["horizon"]), rms(masks["ground"]), float(np.sqrt(noise))
    )
