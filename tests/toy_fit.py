"""Fits of a quick model by the processes of a run over many images: what a process needs is what it can import."""

import jax
from quick_sky import Toy

from diffatmo import models
from diffatmo.cli import running

COMPILED: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: COMPILED.append(event) if event.endswith("backend_compile_duration") else None
)


def run_quietly(job, directory, overwrite):
    models.MODELS["moments"] = Toy
    COMPILED.clear()
    ORIGINAL(job, directory, overwrite)
    (directory / "compilations").write_text(str(len(COMPILED)))


ORIGINAL = running.run_quietly
