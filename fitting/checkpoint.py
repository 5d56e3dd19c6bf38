"""The best point of a fit that is still running, on disk, so that a killed run loses one step.

The file is NumPy's ``.npz`` without pickles and always whole. It says which fit it belongs to by a digest of the images and of
everything said about the fit; another fit refuses it.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from diffatmo import imageio
from fitting._errors import DAMAGED, FitError

FILE = "checkpoint.npz"


class Others(NamedTuple):
    """What other starts have led to; points are in the coordinates of the fit."""

    rivals: Sequence[list[float]] = ()
    """Points near other minima than the best."""
    tried: int = 0
    """How many starts have been tried, when all that are wanted were."""
    given: float = math.nan
    """χ² of what the start that was given led to."""
    underway: Sequence[list[float]] = ()
    """Until then, how far each has come; all but the last have ended."""


class Checkpoint(NamedTuple):
    """Where a fit stands."""

    y: Float[np.ndarray, " n"]
    """The best point of the present stage."""
    step_size: float
    """Inverse of the damping of the next step."""
    max_steps: int
    """How many steps there may be, with those that other starts have taken."""
    final: bool
    """Whether sigma comes from the fitted signal already."""
    understated: float
    """Factor between the residuals and the noise, as far as the fit knows it."""
    others: Others
    history: list[dict[str, Any]]
    """A row for each step."""


def digest(*parts: Any) -> str:
    """What tells one fit from another: of arrays their bytes, of everything else its text."""
    leaves, structure = jax.tree.flatten(parts)
    found = hashlib.sha256(str(structure).encode())
    for leaf in leaves:
        array = isinstance(leaf, np.ndarray | jax.Array)
        found.update(np.asarray(leaf).tobytes() if array else repr(leaf).encode())
    return found.hexdigest()


def save(path: Path, fit: str, checkpoint: Checkpoint) -> None:
    """Replace the file at ``path``. Raises :class:`FitError` if it cannot be written."""
    record = json.dumps({"fit": fit} | {key: value for key, value in checkpoint._asdict().items() if key != "y"})
    try:
        with imageio.atomic_write(path, overwrite=True) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, y=checkpoint.y, record=np.frombuffer(record.encode(), np.uint8))
    except imageio.ImageError as error:
        raise FitError(str(error)) from error


def load(path: Path, fit: str) -> Checkpoint | None:
    """The checkpoint at ``path``, None if there is none; raises :class:`FitError` if it is of another fit or damaged."""
    if not path.exists():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            y, record = archive["y"], json.loads(archive["record"].tobytes())
        owner = record.pop("fit")
        whole = {"y", *record} == {*Checkpoint._fields}
        checkpoint = Checkpoint(y, **record | {"others": Others(*record["others"])}) if whole else None
    except OSError as error:
        raise FitError(f"{path}: cannot be read: {error.strerror or error}") from error
    except DAMAGED as error:
        raise FitError(f"{path}: not a checkpoint of a fit; remove it to start anew") from error
    if owner != fit:
        raise FitError(f"{path}: belongs to a fit of other images or options; remove it to start anew")
    if checkpoint is None:
        raise FitError(f"{path}: written by another version of diffatmo; remove it to start anew")
    return checkpoint
