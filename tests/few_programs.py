"""Skies looked at in any number of directions by programs for one: most of the time of the tests goes to the compiler."""

import equinox as eqx
import jax
import numpy as np

COMPILE_FAST = {"xla_backend_optimization_level": 0}
"""Half the time to compile, for twice that to run."""

RAYS = 28


def in_batches(program):
    """``program`` of a sky, altitude, directions and sun, given always as many directions at a time."""
    compiled = eqx.filter_jit(program, compiler_options=COMPILE_FAST)

    def answer(sky, altitude, view, sun):
        flat = np.asarray(view).reshape(-1, 3)
        padded = np.concatenate([flat, np.broadcast_to(flat[0], (-len(flat) % RAYS, 3))]).reshape(-1, RAYS, 3)
        answers = [compiled(sky, np.asarray(altitude, flat.dtype), part, sun) for part in padded]
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(flat)].reshape(*view.shape[:-1], -1), *answers)

    return answer


radiance = in_batches(lambda sky, altitude, view, sun: sky.radiance(altitude=altitude, view=view, sun=sun))
viewed = in_batches(lambda sky, altitude, view, sun: sky.view(altitude=altitude, sun=sun).radiance(view=view))
