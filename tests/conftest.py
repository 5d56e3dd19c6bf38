"""Fixtures shared by the whole suite."""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import pytest

from diffatmo.atmosphere import Atmosphere

matplotlib.use("Agg")


@pytest.fixture
def x64():
    """Double precision inside one test; the rest of the suite runs in the float32 that users get."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference data that lies beside a checkout and is not part of the project."""
    path = Path(__file__).resolve().parents[2] / "shared"
    if not path.is_dir():
        pytest.skip(f"reference data not found at {path}: they are kept beside the project, not in it")
    return path


@pytest.fixture
def s1() -> Atmosphere:
    """Scene S1, for which all reference tables were computed (in the precision of the test that asks)."""
    return Atmosphere(
        wavelengths=jnp.array([680.0, 550.0, 440.0]),
        solar_irradiance=jnp.ones(3),
        bottom_radius=6360.0,
        top_radius=6460.0,
        rayleigh_scattering=jnp.array([5.802e-3, 13.558e-3, 33.1e-3]),
        rayleigh_scale_height=8.0,
        mie_scattering=jnp.full(3, 3.996e-3),
        mie_absorption=jnp.full(3, 0.444e-3),
        mie_scale_height=1.2,
        mie_g=0.8,
        ozone_absorption=jnp.zeros(3),
        ground_albedo=jnp.full(3, 0.3),
    )
