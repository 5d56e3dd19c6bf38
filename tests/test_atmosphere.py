"""The parameters: round trip, refusals, presets, density profiles."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import atmosphere
from diffatmo.atmosphere import AtmosphereError, DensityProfile, earth, mars

GOOD = """
wavelengths_nm = [680.0, 550.0, 440.0]
solar_irradiance = [1.0, 1.0, 1.0]
bottom_radius_km = 6360.0
top_radius_km = 6460.0
rayleigh_scattering_per_km = [5.802e-3, 13.558e-3, 33.1e-3]
rayleigh_scale_height_km = 8.0
mie_scattering_per_km = [3.996e-3, 3.996e-3, 3.996e-3]
mie_absorption_per_km = [0.444e-3, 0.444e-3, 0.444e-3]
mie_scale_height_km = 1.2
mie_phase = "henyey-greenstein"
mie_g = 0.8
ozone_absorption_per_km = [0.0, 0.0, 0.0]
ground_albedo = [0.3, 0.3, 0.3]
"""


def same(a, b):
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(x, y) and x.dtype == y.dtype for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@pytest.mark.parametrize(
    "make", [earth, mars, lambda: earth(jnp.linspace(400, 700, 7)), lambda: atmosphere.loads(GOOD)]
)
def test_toml_round_trip_loses_nothing(make, tmp_path):
    original = make()
    atmosphere.save(original, tmp_path / "a.toml")
    assert same(atmosphere.load(tmp_path / "a.toml"), original)


def test_toml_round_trip_in_double_precision(x64):
    original = eqx.tree_at(lambda a: a.mie_g, earth(), jnp.asarray(1 / 3))
    assert same(atmosphere.loads(atmosphere.dumps(original)), original)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("mie_g = 0.8", "mie_g = 1.0", "mie_g"),
        ("mie_g = 0.8", "mie_g = -1.5", "-1 < g < 1"),
        ("mie_g = 0.8", "mie_g = nan", "mie_g"),
        ("mie_g = 0.8", 'mie_g = "big"', "mie_g"),
        ("mie_g = 0.8", "mie_g = true", "mie_g"),
        ("mie_g = 0.8", "", "mie_g: missing"),
        ("mie_g = 0.8", "mie_g = 0.8\nmie_G = 0.8", "mie_G: unknown"),
        ("= 6460.0", "= 6360.0", "top_radius_km"),
        ("= 6360.0", "= -1.0", "bottom_radius_km"),
        ("[5.802e-3, ", "[-5.802e-3, ", "rayleigh_scattering_per_km"),
        ("[5.802e-3, ", "[", "rayleigh_scattering_per_km"),
        ("[5.802e-3, 13.558e-3, 33.1e-3]", "0.1", "rayleigh_scattering_per_km"),
        ("[5.802e-3, 13.558e-3, 33.1e-3]", "[]", "rayleigh_scattering_per_km"),
        ("[5.802e-3, ", "[inf, ", "rayleigh_scattering_per_km"),
        ("[5.802e-3, ", "[1e300, ", "rayleigh_scattering_per_km"),
        ("rayleigh_scale_height_km = 8.0", "rayleigh_scale_height_km = 1e300", "finite numbers"),
        ("rayleigh_scale_height_km = 8.0", "rayleigh_scale_height_km = 0.0", "rayleigh_scale_height_km"),
        ("rayleigh_scale_height_km = 8.0", "rayleigh_scale_height = 8.0", "did you mean 'rayleigh_scale_height_km'?"),
        ("[0.3, 0.3, 0.3]", "[0.3, 0.3, 1.1]", "got [0.3, 0.3, 1.1], expected numbers from 0 to 1"),
        ("[0.0, 0.0, 0.0]", "[0.0, -1.0, 0.0]", "ozone_absorption_per_km"),
        ('"henyey-greenstein"', '"mie"', "cornette-shanks"),
        ('"henyey-greenstein"', "1", "mie_phase"),
        ("[680.0, 550.0, 440.0]", "[680.0, 550.0, 0.0]", "wavelengths_nm"),
        ("[680.0, 550.0, 440.0]", "[0.68, 0.55, 0.44]", "expected nm, from 10 to 1e+06"),
        ("[680.0, 550.0, 440.0]", "[680.0", "not a TOML file"),
    ],
)
def test_bad_values_are_refused_by_name(old, new, named):
    assert old in GOOD
    with pytest.raises(AtmosphereError, match=r"test\.toml") as refusal:
        atmosphere.loads(GOOD.replace(old, new), "test.toml")
    assert named in str(refusal.value)


@pytest.mark.parametrize("value", ["big", [["a"]], object, {}])
def test_what_is_no_number_is_refused_by_name(value):
    with pytest.raises(AtmosphereError, match=r"^mie_g: got .*, expected numbers"):
        replace(earth(), mie_g=value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(AtmosphereError, match=r"nothing\.toml"):
        atmosphere.load(tmp_path / "nothing.toml")


def test_is_a_pytree_of_arrays_that_jit_and_vmap_take():
    many = jax.vmap(lambda g: eqx.tree_at(lambda a: a.mie_g, earth(), g))(jnp.array([0.5, 0.6]))
    depth = jax.jit(jax.vmap(lambda a: a.mie_optical_depth * a.mie_g))(many)
    assert depth.shape == (2, 3)
    with pytest.raises((AttributeError, TypeError)):
        earth().mie_g = 0.5


def test_density_profiles():
    h = jnp.array([0.0, 8.0, 10.0, 17.5, 25.0, 32.5, 40.0, 60.0])
    tent = DensityProfile.tent(jnp.asarray(25.0), jnp.asarray(15.0))(h)
    np.testing.assert_allclose(tent, [0, 0, 0, 0.5, 1, 0.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(DensityProfile.exponential(jnp.asarray(8.0))(h), np.exp(-h / 8), rtol=1e-6)


def test_optical_depths_of_the_earth_are_the_known_ones():
    """β_R(550 nm) is 1.149e-2 /km at sea level (σ = 4.513e-27 cm², Bucholtz 1995, table 2); 13.558e-3 is Bruneton's choice."""
    assert float(earth().rayleigh_optical_depth[1]) == pytest.approx(0.10846, rel=1e-4)
    assert float(earth([550.0]).rayleigh_scattering[0]) == pytest.approx(1.149e-2, rel=0.005)
    assert float(mars().mie_optical_depth[0]) == pytest.approx(0.5, rel=1e-6)
    assert float(mars().rayleigh_optical_depth[2]) < 0.02
