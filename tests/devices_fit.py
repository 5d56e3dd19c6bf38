"""A fit on as many devices as there are, for tests/test_devices.py: python devices_fit.py OUT [COORDINATOR PROCESSES ID]."""

import json
import sys
from pathlib import Path

import jax
import numpy as np

out, *distributed = sys.argv[1:]
if distributed:
    jax.distributed.initialize(distributed[0], int(distributed[1]), int(distributed[2]))

import toy_sky  # noqa: E402

import fitting  # noqa: E402

MASK = np.random.default_rng(0).random(toy_sky.DIRECTIONS.shape[:2]) < 0.9
"""So that no number of devices divides that of the pixels."""


def main() -> None:
    images = toy_sky.observations(mask=MASK, exposure=("free", "fixed", "free"), pedestal="body")
    result = fitting.fit(
        images,
        init=toy_sky.start(),
        free=toy_sky.FREE,
        tie={"mie_absorption": "start"},
        priors=[fitting.Prior("rayleigh_scale_height", 8.0, 0.3)],
        loss="huber",
        model=toy_sky.Hasty(),
    )
    assert result.converged, result.message
    numbers = {
        "estimates": [[e.value, e.standard_error] for e in [*result.parameters, *result.nuisances]],
        "image": np.stack(result.fitted)[:, ::5, ::7].tolist(),
        "devices": [len(jax.devices()), jax.process_count()],
    }
    Path(out).write_text(json.dumps(numbers))


if __name__ == "__main__":
    main()
