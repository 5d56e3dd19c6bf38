"""Tabulated phase functions: exact for what is linear in nu, equal to a formula that they sample finely, in every model."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import COMPILE_FAST

import diffatmo
from diffatmo import atmosphere, phase, sun
from diffatmo.atmosphere import AtmosphereError
from diffatmo.phase import PhaseTable
from fitting import FitError
from fitting.parameters import select

G = 0.7
FINE_DEG = np.concatenate([np.linspace(0, 10, 101), np.linspace(10.5, 180, 340)])


def tabulated(g=G, unit=1.0):
    value = phase.henyey_greenstein(np.cos(np.radians(FINE_DEG)), g)
    return PhaseTable(FINE_DEG, unit * np.asarray(value, float))


def test_lines_in_nu_are_exact(x64):
    """Constant: χ = 1, 0, 0. 1 + nu: χ_1 = 1/3 and nothing beyond. In any unit."""
    g = jnp.asarray(0.0)
    np.testing.assert_allclose(phase.mie_moments(g, 4, PhaseTable([0, 180], [7, 7])), [1, 0, 0, 0, 0], atol=1e-14)
    line = PhaseTable([0, 60, 180], [20, 15, 0])
    np.testing.assert_allclose(phase.mie_moments(g, 4, line), [1, 1 / 3, 0, 0, 0], atol=1e-14)
    np.testing.assert_allclose(
        phase.mie(jnp.array([-1.0, 0.5, 1.0]), g, line), np.array([0, 1.5, 2]) / (4 * np.pi), atol=1e-15
    )
    assert line.asymmetry == pytest.approx(1 / 3)


def test_a_fine_table_is_the_formula(x64):
    """0.1 to 0.5° steps follow Henyey-Greenstein to 1e-3, and so do moments and repeated scattering."""
    nu = jnp.cos(jnp.linspace(0, jnp.pi, 301))
    table, g = tabulated(unit=123.0), jnp.asarray(G)
    np.testing.assert_allclose(phase.mie(nu, g, table), phase.henyey_greenstein(nu, g), rtol=1e-3)
    np.testing.assert_allclose(phase.mie_moments(g, 12, table), G ** np.arange(13), rtol=1e-3)
    for order in (2, 3):
        exact = phase.repeated(nu, g, "henyey-greenstein", order, 8)
        np.testing.assert_allclose(phase.repeated(nu, g, table, order, 8), exact, atol=2e-3 * float(exact.max()))


def test_derivatives_are_finite(x64):
    """In nu, also at the ends and on a node; the asymmetry of the atmosphere has no part in it."""
    slope = jax.vmap(jax.grad(lambda nu: phase.mie(nu, jnp.asarray(G), tabulated())))(jnp.array([-1.0, 0.0, 0.3, 1.0]))
    assert np.all(np.isfinite(slope))
    assert float(jax.grad(lambda g: phase.mie(jnp.asarray(0.3), g, tabulated()))(G)) == 0


@pytest.mark.parametrize(
    ("angles", "values", "said"),
    [
        ([0, 90, 180], [1, -0.1, 1], "not negative"),
        ([0, 180], [0, 0], "not all 0"),
        ([0, 90], [1, 1], "0 to 180"),
        ([0, 90, 90, 180], [1, 1, 1, 1], "rise"),
        ([0, 180], [1, 1, 1], "as many"),
        ([0, 180], [1, float("nan")], "finite"),
    ],
)
def test_bad_tables_are_refused(angles, values, said):
    with pytest.raises(ValueError, match=said):
        PhaseTable(angles, values)
    keys = atmosphere.to_dict(diffatmo.earth()) | {
        "mie_phase": "tabulated", "mie_phase_angles_deg": angles, "mie_phase_values": values
    }  # fmt: skip
    with pytest.raises(AtmosphereError, match="mie_phase_values"):
        atmosphere.from_dict(keys)


def test_files_keep_the_table():
    air = replace(diffatmo.earth(), mie_phase=tabulated(unit=3.0))
    again = atmosphere.loads(atmosphere.dumps(air))
    assert again.mie_phase == air.mie_phase
    # The asymmetry may be left out: it is the table's.
    keys = atmosphere.to_dict(air)
    del keys["mie_g"]
    assert float(atmosphere.from_dict(keys).mie_g) == pytest.approx(G, abs=1e-3)
    with pytest.raises(AtmosphereError, match="mie_phase is not 'tabulated'"):
        atmosphere.from_dict(keys | {"mie_phase": "henyey-greenstein"})
    with pytest.raises(AtmosphereError, match="mie_phase_values"):
        atmosphere.from_dict({k: v for k, v in keys.items() if k != "mie_phase_values"})
    with pytest.raises(FitError, match="tabulated"):
        select(air, ["mie_g"])


VIEW = sun.direction(
    zenith=jnp.radians(jnp.array([5.0, 40.0, 60.0, 80.0, 88.0, 130.0])),
    azimuth=jnp.radians(jnp.array([0.0, 30, 100, 180, 60, 20])),
)
TOWARDS = sun.direction(zenith=jnp.radians(55.0), azimuth=0.0)


@partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
def seen(model, air):
    return model.sky(air).view(altitude=0.5, sun=TOWARDS).radiance(view=VIEW).radiance


@pytest.mark.parametrize(
    "model", [diffatmo.Moments(), diffatmo.Hillaire(), diffatmo.RayMarch()], ids=lambda m: type(m).__name__
)
def test_models_take_it(model):
    """Haze of optical depth 0.3 with the formula and with its table."""
    haze = replace(diffatmo.earth(), mie_scattering=jnp.full(3, 0.13), mie_scale_height=2.2, mie_g=G)
    got, wanted = seen(model, replace(haze, mie_phase=tabulated())), seen(model, haze)
    np.testing.assert_allclose(got, wanted, rtol=2e-3)


def test_a_table_that_is_zero_wherever_one_looks_is_no_division_by_zero():
    """Light goes back within 10° only, between the nodes at which moments sum the peak: its light is spread, not lost."""
    haze = replace(diffatmo.earth(), mie_scattering=jnp.full(3, 0.13), mie_scale_height=2.2)
    backward = replace(haze, mie_phase=PhaseTable([0, 170, 180], [0, 0, 1]))
    back = np.asarray(seen(diffatmo.Moments(), backward))
    clear = np.asarray(
        seen(diffatmo.Moments(), replace(haze, mie_scattering=jnp.zeros(3), mie_absorption=jnp.zeros(3)))
    )
    assert np.all(np.isfinite(back))
    # What the haze takes from the sun's light goes somewhere: the sky is not black.
    assert np.all(back > 0.3 * clear)
    # The orders of scattering fall off: light thrown back was once taken for a forward peak, and each was 2.5 times the last.
    np.testing.assert_allclose(seen(replace(diffatmo.Moments(), order=6), backward), back, rtol=0.02)


def test_the_path_tracer_samples_it():
    """Within the standard errors of both; a table with more peak is another sky."""
    haze = replace(diffatmo.earth(), mie_scattering=jnp.full(3, 0.13), mie_scale_height=2.2, mie_g=G)

    def traced(air, seed):
        sky = diffatmo.PathTrace(samples=4096, seed=seed).sky(air)
        return sky.radiance_with_error(altitude=jnp.asarray(0.5), view=VIEW, sun=TOWARDS)

    def apart(a, b):
        return np.abs(np.asarray((a.radiance - b.radiance) / np.hypot(a.stderr, b.stderr))).max()

    table = traced(replace(haze, mie_phase=tabulated()), 1)
    assert apart(table, traced(haze, 0)) < 4.5
    assert apart(table, traced(replace(haze, mie_g=0.75), 2)) > 10
