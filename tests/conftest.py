"""Fixtures shared by the whole suite."""

import ctypes
import gc
import os
from contextlib import suppress
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from few_programs import COMPILE_FAST
from quick_sky import Toy

from diffatmo import models
from diffatmo.atmosphere import Atmosphere

matplotlib.use("Agg")

# Half of what Python collects while programs are traced are the modules, which stay.
gc.freeze()
gc.set_threshold(50_000, 20, 20)


PROGRAMS_AT_MOST = 2e9
"""Bytes of memory beyond which compiled programs are dropped: of the thousands that the suite needs, each is kept for ever."""


def pytest_collection_modifyitems(items):
    """The longest tests first, so that no process waits for them at the end."""
    items.sort(key=lambda item: item.path.name != "test_gradients.py")


@pytest.fixture(scope="session", autouse=True)
def _keep_programs(tmp_path_factory):
    """Programs that were dropped, and those of the commands that tests start, are found again on disk.

    Every worker has a folder of its own, as JAX does not guard its files against other processes.
    """
    folder = str(tmp_path_factory.mktemp("programs"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", folder)
        jax.config.update("jax_compilation_cache_dir", folder)
        yield
        jax.config.update("jax_compilation_cache_dir", None)


@pytest.fixture(autouse=True)
def _drop_programs():
    """Not after every module: files share programs, and a process needs a gigabyte before it has to let go of them."""
    yield
    if _resident() > PROGRAMS_AT_MOST:
        jax.clear_caches()
        # The C library would keep what is free now for later.
        with suppress(AttributeError, OSError, TypeError):
            ctypes.CDLL(None).malloc_trim(0)


def _resident() -> float:
    """Bytes of memory that the process has; 0 where there is no way to know."""
    with suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


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


@pytest.fixture
def toy(monkeypatch):
    """Commands find a sky of a few operations where the models were."""
    for name in ("moments", "raymarch"):
        monkeypatch.setitem(models.MODELS, name, Toy)


@pytest.fixture(scope="session")
def _compilations() -> list[str]:
    events: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: events.append(event) if event.endswith("backend_compile_duration") else None
    )
    return events


@pytest.fixture
def compilations(_compilations) -> list[str]:
    """Grows by one whenever JAX compiles a program."""
    _compilations.clear()
    return _compilations


@pytest.fixture
def check_jacobian():
    """Compare forward and reverse derivatives with central differences; use it together with ``x64``.

    ``check_jacobian(function, points, *rest)``: the derivative of ``function(x, *rest)`` in the vector ``x`` at each of
    ``points``, relative to the largest entry of each column. ``rest`` are arguments, because what a compiled function
    closes over is folded into constants, which can take minutes. Returns the forward derivative at each point.
    """

    def check(function, points, *rest, step=1e-5, tolerance=1e-5):
        slopes = []
        for point in points:
            numeric, forward, reverse = map(np.asarray, _jacobians(function, jnp.asarray(point), step, *rest))
            scale = np.abs(numeric).max(0)
            # A column may vanish by symmetry; then it is compared with the others.
            scale = np.maximum(scale, 1e-3 * scale.max())
            np.testing.assert_allclose(forward / scale, numeric / scale, atol=tolerance)
            np.testing.assert_allclose(reverse / scale, numeric / scale, atol=tolerance)
            slopes.append(forward)
        return slopes

    return check


@partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
def _jacobians(function, x, step, *rest):
    """By central differences, forward and reverse; compiled once for a function and the shapes of its arguments."""

    def flat(x):
        return jnp.ravel(function(x, *rest))

    shifts = step * jnp.eye(x.size)
    around = jax.lax.map(lambda shift: flat(x + shift), jnp.concatenate([shifts, -shifts]))
    numeric = (around[: x.size] - around[x.size :]).T / (2 * step)
    return numeric, jax.jacfwd(flat)(x), jax.jacrev(flat)(x)
