"""The gradient matrix: every parameter of atmosphere, sun and altitude × moments and raymarch, against differences.

Camera pose is tested with the cameras (`test_camera.py`, `test_render.py`); here it would be the same view directions.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import COMPILE_FAST

from diffatmo.atmosphere import earth
from diffatmo.models import hillaire
from diffatmo.models.bruneton import Bruneton, Sizes, Steps
from diffatmo.models.hillaire import Hillaire
from diffatmo.models.moments import Moments
from diffatmo.models.moments.shell import Directions
from diffatmo.models.raymarch import RayMarch

FIELDS = (
    "rayleigh_scattering", "rayleigh_scale_height", "mie_scattering", "mie_absorption", "mie_scale_height", "mie_g",
    "ozone_absorption", "ozone_center_altitude", "ozone_half_width", "ground_albedo", "solar_irradiance",
    "bottom_radius", "top_radius",
)  # fmt: skip

# A derivative is a property of the code, not of the resolution: few nodes keep compilation and differences cheap.
SMALL = Moments(
    altitudes=5, suns=9, first=Directions(4, 3, 3, 2, 4), iterate=Directions(3, 2, 3, 2, 2), last=Directions(3, 2, 4, 2, 3),
    source_degree=3, peak_azimuths=6, order=3, view_steps=3, view_sky=9, view_ground=7, view_columns=5,
    view_fine_columns=9,
)  # fmt: skip
TABLES = Bruneton(sizes=Sizes(8, 16, 4, 8, 4, 8, 6, 4), steps=Steps(19, 5, 5, 4, 4), orders=3, quadrature="gauss")
"""19: with 20, samples of the vertical ray would fall on the very edges of the absorber, where its slope jumps."""
LUTS = Hillaire((16, 8), (6, 6), (12, 12), hillaire.Steps(19, 5, 5, 5, 3))
MODELS = {"moments": SMALL, "bruneton": TABLES, "hillaire": LUTS, "raymarch": RayMarch(steps=4)}


def unit(zenith_deg, azimuth_deg):
    z, a = np.radians(zenith_deg), np.radians(azimuth_deg)
    return np.array([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)])


def pack(sun_zenith_deg, altitude):
    """Relative changes of the atmosphere's fields, then the sun's direction and the altitude."""
    return jnp.asarray(np.concatenate([np.zeros(len(FIELDS)), unit(sun_zenith_deg, 20.0), [altitude]]))


def make(model, atmosphere, how):
    view = jnp.asarray(np.stack([unit(z, a) for z, a in ((0, 0), (35, 60), (80, 170), (89.0, 10), (120, 40))]))

    def radiance(x):
        fields = tuple(getattr(atmosphere, name) * (1 + x[i]) for i, name in enumerate(FIELDS))
        changed = eqx.tree_at(lambda a: tuple(getattr(a, name) for name in FIELDS), atmosphere, fields)
        # On the unit sphere, whatever step is taken.
        sun = x[-4:-1] / jnp.linalg.norm(x[-4:-1])
        sky = model.sky(changed)
        if how == "view":
            return sky.view(altitude=x[-1], sun=sun).radiance(view=view).radiance
        return sky.radiance(altitude=x[-1], view=view, sun=sun).radiance

    return radiance


CASES = [("moments", "view"), ("bruneton", "path"), ("hillaire", "view"), ("raymarch", "path")]


@pytest.mark.parametrize(("name", "how"), CASES)
def test_forward_and_reverse_against_differences(x64, name, how):
    """Ordinary points to 1e-5 of the largest change; zenith, horizon, g = 0 and no density finite."""
    atmosphere = earth()
    model = make(MODELS[name], atmosphere, how)
    function, forward = (jax.jit(f, compiler_options=COMPILE_FAST) for f in (model, jax.jacfwd(model)))
    # One random combination of all outputs: reverse mode of a sum that no coincidence makes right.
    weight = jnp.asarray(np.random.default_rng(5).normal(size=(5, 3)))
    reverse = jax.jit(lambda x: jax.vjp(model, x)[1](weight)[0], compiler_options=COMPILE_FAST)
    x = pack(50.0, 0.7)
    exact = forward(x)
    # Linear interpolation has two derivatives at the entries of a table, and rounding chooses.
    rtol = 1e-6 if name in ("bruneton", "hillaire") else 1e-8
    np.testing.assert_allclose(reverse(x), jnp.tensordot(weight, exact, 2), rtol=rtol, atol=1e-12)
    for i in range(x.size):
        step = 1e-5 * max(1.0, abs(float(x[i])))
        numeric = (function(x.at[i].add(step)) - function(x.at[i].add(-step))) / (2 * step)
        scale = float(jnp.abs(numeric).max()) + 1e-9
        np.testing.assert_allclose(exact[..., i], numeric, atol=1e-5 * scale, err_msg=f"parameter {i}")
    for sun_zenith_deg in (0.0, 90.0, 100.0):
        for altitude in (0.0, 0.7):
            there = pack(sun_zenith_deg, altitude)
            assert jnp.isfinite(forward(there)).all(), (sun_zenith_deg, altitude)
            assert jnp.isfinite(reverse(there)).all(), (sun_zenith_deg, altitude)


@pytest.mark.parametrize("name", MODELS)
def test_derivatives_at_zero_are_finite(x64, name):
    """g = 0, no aerosol, no air, black ground: value and derivative by the value itself, not by its relative change."""
    zero = eqx.tree_at(
        lambda a: (a.mie_g, a.mie_scattering, a.mie_absorption, a.rayleigh_scattering, a.ozone_absorption, a.ground_albedo),
        earth(), (jnp.zeros(()), *(jnp.zeros(3),) * 5),
    )  # fmt: skip
    view, sun = jnp.asarray(np.stack([unit(30, 0), unit(89.9, 0), unit(150, 0)])), jnp.asarray(unit(60.0, 0.0))
    thin = eqx.tree_at(
        lambda a: (a.mie_scattering, a.rayleigh_scattering), earth(),
        (1e-6 * earth().mie_scattering, 1e-6 * earth().rayleigh_scattering),
    )  # fmt: skip
    function = jax.jit(
        jax.jacfwd(lambda a: MODELS[name].sky(a).radiance(altitude=jnp.asarray(0.5), view=view, sun=sun).radiance),
        compiler_options=COMPILE_FAST,
    )
    # Orders of scattering shrink with the air; the ratio of two of them must not overflow.
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(function(thin)))
    slopes = function(zero)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slopes))
    assert float(jnp.abs(slopes.mie_scattering).max()) > 0
