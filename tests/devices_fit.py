"""A fit on as many devices as there are, for tests/test_devices.py: python devices_fit.py OUT [COORDINATOR PROCESSES ID]."""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

out, *distributed = sys.argv[1:]
if distributed:
    jax.distributed.initialize(distributed[0], int(distributed[1]), int(distributed[2]))

import toy_sky  # noqa: E402

import fitting  # noqa: E402
from fitting.batch import stack  # noqa: E402
from fitting.devices import mesh_of  # noqa: E402
from fitting.evaluation import corrected, evaluated, pose  # noqa: E402
from fitting.least_squares import reduce  # noqa: E402
from fitting.parameters import select  # noqa: E402

MASK = np.random.default_rng(0).random(toy_sky.DIRECTIONS.shape[:2]) < 0.9
"""So that no number of devices divides that of the pixels."""


def gram(images) -> np.ndarray:
    """JᵀJ, and Jᵀr, of a model whose correction by a finer one changes, at the truth."""
    parameters = select(toy_sky.truth(), toy_sky.FREE, {"mie_absorption": "start"})
    model = toy_sky.Hasty()
    batch = stack(images, [680.0, 550.0, 440.0], mesh_of(None))
    problem = pose(batch, parameters, (), None, model, model.finer())
    x, linear = problem.start, jnp.zeros(batch.nuisances.linear)
    y = jnp.concatenate([x, linear])
    problem = corrected(y, evaluated(x, linear, problem), problem, model.finer())
    assert np.any(problem.correction.along)
    factor = reduce(y, evaluated(x, linear, problem), problem)
    return factor.T @ factor


def main() -> None:
    images = toy_sky.observations(mask=MASK, exposure=("free", "fixed", "free"), pedestal="body")
    result = fitting.fit(
        images,
        init=toy_sky.start(),
        free=toy_sky.FREE,
        tie={"mie_absorption": "start"},
        priors=[fitting.Prior("rayleigh_scale_height", 8.0, 0.3)],
        loss="huber",
        model=toy_sky.Toy(),
    )
    assert result.converged, result.message
    numbers = {
        "estimates": [[e.value, e.standard_error] for e in [*result.parameters, *result.nuisances]],
        "image": np.stack(result.fitted)[:, ::5, ::7].tolist(),
        "gram": gram(images).tolist(),
        "devices": [len(jax.devices()), jax.process_count()],
    }
    Path(out).write_text(json.dumps(numbers))


if __name__ == "__main__":
    main()
