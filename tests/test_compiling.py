"""Options of the compiler change how long it takes, never what comes out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffatmo
from diffatmo.compiling import compile_ahead, outermost
from diffatmo.numerics import once


def shift(x, by):
    return jnp.sin(x) + by


def test_options_are_ones_that_this_compiler_knows():
    options = diffatmo.compiler_options()
    assert options or jax.default_backend() != "cpu"
    x = jnp.linspace(0, 1, 5)
    np.testing.assert_allclose(jax.jit(shift, compiler_options=options)(x, 1.0), shift(x, 1.0), rtol=1e-6)


def test_options_of_another_compiler_are_left_out(monkeypatch):
    monkeypatch.setattr("diffatmo.compiling._CPU", {"xla_cpu_no_such_option": True})
    diffatmo.compiler_options.cache_clear()
    assert diffatmo.compiler_options() == {}
    diffatmo.compiler_options.cache_clear()


def test_what_is_compiled_ahead_is_not_compiled_again():
    traces = []

    def counted(x, by):
        traces.append(1)
        return shift(x, by)

    x = jnp.linspace(0, 1, 7)
    compile_ahead(counted, jax.ShapeDtypeStruct(x.shape, x.dtype), by=x).join()
    np.testing.assert_allclose(outermost(counted)(x, by=x), shift(x, x), rtol=1e-6)
    assert len(traces) == 1


@pytest.mark.parametrize(("keep", "formulas"), [(lambda y: y, 2), (once, 1)])
def test_what_several_loops_use_is_computed_once(keep, formulas):
    """XLA would rather repeat something cheap than keep it: here a formula with one comparison, used by two loops."""

    def used_twice(x, a, b, c):
        y = keep(jnp.where(x > 0.5, x, 1 - x))
        return (y[:, None] * a) @ b, y * c

    shapes = (50,), (50, 60), (60, 9), (20, 50)
    program = jax.jit(used_twice, compiler_options=diffatmo.compiler_options())
    text = program.lower(*(jnp.ones(shape) for shape in shapes)).compile().as_text()
    assert jax.default_backend() != "cpu" or text.count(" compare(") == formulas
