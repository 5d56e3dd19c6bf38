"""The gradient matrix: every number of atmosphere, sun and altitude × every model that has derivatives, against differences.

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

# A derivative is a property of the code, not of the resolution: few nodes keep compilation and differences cheap.
SMALL = Moments(
    altitudes=5, suns=9, first=Directions(4, 3, 3, 2, 4), iterate=Directions(3, 2, 3, 2, 2), last=Directions(3, 2, 4, 2, 3),
    source_degree=3, peak_azimuths=6, order=4, view_steps=3, view_sky=9, view_ground=7, view_columns=5,
    view_fine_columns=9,
)  # fmt: skip
TABLES = Bruneton(sizes=Sizes(8, 16, 4, 8, 4, 8, 6, 4), steps=Steps(19, 5, 5, 4, 4), orders=3, quadrature="gauss")
"""19: with 20, samples of the vertical ray would fall on the very edges of the absorber, where its slope jumps."""
LUTS = Hillaire((16, 8), (6, 6), (12, 12), hillaire.Steps(19, 5, 5, 5, 3))
MODELS = {"moments": SMALL, "bruneton": TABLES, "hillaire": LUTS, "raymarch": RayMarch(steps=4)}


def unit(zenith_deg, azimuth_deg):
    z, a = np.radians(zenith_deg), np.radians(azimuth_deg)
    return np.array([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)])


LEAVES, TREE = jax.tree.flatten_with_path(earth())
NAMES = [f"{path[0].name}[{i}]" for path, leaf in LEAVES for i in range(leaf.size)] + ["sun"] * 3 + ["altitude"]


def pack(atmosphere, sun_zenith_deg, altitude):
    """All numbers of the atmosphere, then the sun's direction and the altitude."""
    numbers = [np.asarray(x, float).ravel() for x in jax.tree.leaves(atmosphere)]
    return np.concatenate([*numbers, unit(sun_zenith_deg, 20.0), [altitude]])


def unpack(x):
    ends = np.cumsum([leaf.size for _, leaf in LEAVES])
    parts = jnp.split(x[:-4], ends[:-1])
    return TREE.unflatten([part.reshape(leaf.shape) for part, (_, leaf) in zip(parts, LEAVES, strict=True)])


def make(model, how):
    view = jnp.asarray(np.stack([unit(z, a) for z, a in ((0, 0), (35, 60), (80, 170), (89.0, 10), (120, 40))]))

    def radiance(x):
        # On the unit sphere, whatever step is taken.
        sun = x[-4:-1] / jnp.linalg.norm(x[-4:-1])
        sky = model.sky(unpack(x))
        asked = {
            "view": lambda: sky.view(altitude=x[-1], sun=sun).radiance(view=view).radiance,
            "path": lambda: sky.radiance(altitude=x[-1], view=view, sun=sun).radiance,
        }
        return jnp.concatenate([asked[way]() for way in how.split("+")])

    return radiance


CASES = [("moments", "view+path"), ("bruneton", "path"), ("hillaire", "view"), ("raymarch", "path")]


@pytest.mark.parametrize(("name", "how"), CASES)
def test_forward_and_reverse_against_differences(x64, name, how):
    """Ordinary points to 1e-5 of the largest change; zenith, horizon, g = 0 and no density finite.

    One tangent at a time: a batch of them, as fits take it, is another program, not another derivative.
    """
    model = make(MODELS[name], how)
    # One random combination of all outputs: reverse mode of a sum that no coincidence makes right.
    weight = np.random.default_rng(5).normal(size=(5 * len(how.split("+")), 3))
    forward = jax.jit(lambda x, v: jax.jvp(model, (x,), (v,)), compiler_options=COMPILE_FAST)
    reverse = jax.jit(lambda x: jax.vjp(model, x)[1](weight)[0], compiler_options=COMPILE_FAST)

    def jacobian(x):
        return np.stack([forward(x, v)[1] for v in np.eye(x.size)], axis=-1)

    x = pack(earth(), 50.0, 0.7)
    exact = jacobian(x)
    # Linear interpolation has two derivatives at the entries of a table, and rounding chooses.
    rtol = 1e-6 if name in ("bruneton", "hillaire") else 1e-8
    np.testing.assert_allclose(reverse(x), np.tensordot(weight, exact, 2), rtol=rtol, atol=1e-12)
    steps = 1e-5 * np.where(x == 0, 1, np.abs(x))
    for i, (number, step) in enumerate(zip(NAMES, np.diag(steps), strict=True)):
        above, below = (np.asarray(forward(x + move, step)[0]) for move in (step, -step))
        numeric = (above - below) / (2 * steps[i])
        scale = np.abs(numeric).max() + 1e-9
        np.testing.assert_allclose(exact[..., i], numeric, atol=1e-5 * scale, err_msg=number)
    for sun_zenith_deg in (0.0, 90.0, 100.0):
        for altitude in (0.0, 0.7):
            there = pack(earth(), sun_zenith_deg, altitude)
            assert jnp.isfinite(jacobian(there)).all(), (sun_zenith_deg, altitude)
            assert jnp.isfinite(reverse(there)).all(), (sun_zenith_deg, altitude)
    # Orders of scattering shrink with the air; the ratio of two of them must not overflow.
    scattering = lambda a: (a.rayleigh_scattering, a.mie_scattering)
    thin = eqx.tree_at(scattering, earth(), tuple(1e-6 * b for b in scattering(earth())))
    vanishing = lambda a: (*scattering(a), a.mie_absorption, a.ozone_absorption, a.ground_albedo)
    empty = eqx.tree_at(lambda a: (a.mie_g, *vanishing(a)), earth(), (jnp.zeros(()), *(jnp.zeros(3),) * 5))
    for air in (thin, empty):
        slopes = jacobian(pack(air, 60.0, 0.5))
        assert jnp.isfinite(slopes).all()
        assert jnp.isfinite(reverse(pack(air, 60.0, 0.5))).all()
        assert jnp.abs(slopes[..., NAMES.index("mie_scattering[0]")]).max() > 0
