"""Aerial perspective: every model, from nothing in front of the lens to the whole sky."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import COMPILE_FAST

from diffatmo import sun
from diffatmo.atmosphere import earth
from diffatmo.camera import Pinhole
from diffatmo.models import Bruneton, Hillaire, Model, Moments, PathTrace, RayMarch, Sky
from diffatmo.render import Scene, aerial_perspective, composite

MODELS = {
    "moments": Moments(),
    "bruneton": replace(Bruneton.reduced(), orders=2),
    "hillaire": Hillaire(),
    "raymarch": RayMarch(),
}
SCENE = Scene(earth(), Pinhole(6, 9, pitch=0.05, fov_y=0.5), 0.3, sun.direction(zenith=1.0, azimuth=0.8))


class Solved(Model):
    """A model that has done its work: one program finds the sky, and smaller ones look at it."""

    solution: Sky

    def sky(self, _):
        return self.solution


seen = functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)(aerial_perspective)
find = functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)(lambda model, air: model.sky(air))


@functools.cache
def solved(name):
    return Solved(find(MODELS[name], SCENE.atmosphere))


@functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
def whole_rays(sky):
    directions = SCENE.camera.directions()
    mu, nu = directions[..., 2], directions @ SCENE.sun
    level, mu_s = jnp.full(mu.shape, 0.3), jnp.broadcast_to(SCENE.sun[2], mu.shape)
    return sky.path(altitude=level, mu=mu, mu_s=mu_s, nu=nu)


@pytest.mark.parametrize("name", MODELS)
def test_from_nothing_to_the_whole_ray(name):
    """No depth, no air; more depth, more of both; beyond the end, what the model says of the whole ray."""
    model = solved(name)
    nothing, near, far, endless = (
        seen(SCENE, np.full((6, 9), depth, np.float32), model) for depth in (0.0, 2.0, 20.0, np.inf)
    )
    np.testing.assert_allclose(nothing.inscatter, 0, atol=1e-6)
    np.testing.assert_allclose(nothing.transmittance, 1, atol=5e-6)
    for less, more in ((near, far), (far, endless)):
        assert np.all(np.asarray(less.inscatter) <= np.asarray(more.inscatter) * 1.01)
        assert np.all(np.asarray(less.transmittance) >= np.asarray(more.transmittance) * 0.999)
    whole = whole_rays(model.solution)
    # moments and raymarch integrate a ray that ends anywhere by another rule.
    np.testing.assert_allclose(endless.inscatter, whole.inscatter, rtol=0.01)
    np.testing.assert_allclose(endless.transmittance, whole.transmittance, atol=3e-3)


def test_two_stretches_make_one():
    """T(a→c) = T(a→b) T(b→c), and light likewise: the second camera stands where the first ray is after 5 km."""
    camera = Pinhole(1, 1, pitch=0.3, fov_y=0.1)
    towards = np.asarray(camera.directions())[0, 0]
    radius, height = 6360.0, 0.3
    beyond = float(np.sqrt((radius + height) ** 2 + 25 + 10 * (radius + height) * float(towards[2])) - radius)
    # There the local vertical has turned by 5 km of ground at most: the sun is put where that frame sees it.
    turn = np.arcsin(5 * np.sqrt(1 - float(towards[2]) ** 2) / (radius + beyond))
    c, s = np.cos(turn), np.sin(turn)
    turned = jnp.asarray([[1, 0, 0], [0, c, -s], [0, s, c]], jnp.float32)
    scene = Scene(earth(), camera, height, SCENE.sun)
    there = Scene(earth(), Pinhole(1, 1, pitch=0.3 + turn, fov_y=0.1), beyond, turned @ SCENE.sun)
    model = solved("moments")
    first, both = (seen(scene, np.full((1, 1), d, np.float32), model) for d in (5.0, 12.0))
    second = seen(there, np.full((1, 1), 7.0, np.float32), model)
    np.testing.assert_allclose(composite(second.inscatter, first), both.inscatter, rtol=2e-3)
    np.testing.assert_allclose(first.transmittance * second.transmittance, both.transmittance, rtol=1e-4)


@pytest.mark.parametrize("name", ["raymarch", "hillaire"])
def test_derivative_in_depth_is_the_source(x64, name):
    """dT/dd = -β_ext T and d(inscatter)/dd = T · J > 0, against differences."""
    scene = Scene(earth(), Pinhole(2, 3, pitch=0.4, fov_y=0.5), 0.3, sun.direction(zenith=1.0, azimuth=0.8))

    model = Solved(find(MODELS[name], scene.atmosphere))

    @functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
    def light_and_slope(depth, scene, model):
        def light(depth):
            path = aerial_perspective(scene, jnp.full((2, 3), depth), model)
            return jnp.stack([path.inscatter, path.transmittance])

        return jax.jvp(light, (depth,), (jnp.ones(()),))

    step = 1e-3
    (less, _), (_, exact), (more, _) = (light_and_slope(jnp.asarray(6 + n * step), scene, model) for n in (-1, 0, 1))
    np.testing.assert_allclose(exact, (more - less) / (2 * step), rtol=1e-3, atol=1e-7)
    assert np.all(np.asarray(exact[0]) > 0)
    assert np.all(np.asarray(exact[1]) < 0)


TRACER = PathTrace(samples=1024, seed=3)


def test_path_tracer_agrees(s1):
    """Five standard errors of 54 pixels at three wavelengths each, and the systematic 0.5 % of a short path."""
    scene = replace(SCENE, atmosphere=s1)
    depth = np.full((6, 9), 15.0, np.float32)
    truth = seen(scene, depth, TRACER)
    got = seen(scene, depth, Solved(find(MODELS["moments"], s1)))
    ratio = np.asarray(got.inscatter / truth.inscatter)
    assert abs(ratio.mean() - 1) < 0.01
    np.testing.assert_allclose(got.transmittance, truth.transmittance, atol=2e-3)


def test_path_tracer_draws_every_pixel_anew(s1):
    """A lens so long that all pixels see the same: what differs is noise, as much between rows as within them."""
    scene = replace(SCENE, atmosphere=s1, camera=replace(SCENE.camera, fov_y=jnp.asarray(1e-4)))
    light = np.asarray(seen(scene, np.full((6, 9), 15.0, np.float32), TRACER).inscatter)
    assert light.std(axis=0, ddof=1).mean() == pytest.approx(light.std(axis=1, ddof=1).mean(), rel=0.3)
    assert len(np.unique(light[..., 0])) == 54
