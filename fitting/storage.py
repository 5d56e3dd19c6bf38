"""A fit in one file, all of it: what :func:`load` gives back looks and works like what was saved, to the bit.

The file is NumPy's ``.npz``, a zip of arrays, of which none is pickled: opening it runs no code. The array ``record`` holds the
bytes of a JSON text: ``schema`` = ``"diffatmo-result"``, ``schema_version``, the ``version`` of diffatmo, and under ``result``
every field of :class:`fitting.findings.Findings`. Where a value is an array, the record has ``{"type": "array", "name": …}``
and the file an array of that name: ``numpy.load(file)["observations.0.image"]`` is the first image. Other objects are the table
of their fields with their ``type``. A model that is not one of diffatmo's own is left out.
"""

import dataclasses
import json
import math
import zipfile
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from diffatmo import imageio
from diffatmo.atmosphere import Atmosphere
from diffatmo.bands import Bands
from diffatmo.camera import PROJECTIONS
from diffatmo.models import MODELS, Model
from diffatmo.phase import PhaseTable
from diffatmo.scan import Scan
from fitting._errors import DAMAGED, FitError
from fitting.findings import Estimate, Findings, Minimum, Profile, Setup
from fitting.observation import Observation
from fitting.priors import Prior
from fitting.search import Step

SCHEMA, SCHEMA_VERSION = "diffatmo-result", 3

RECORD = "record"

F = TypeVar("F", bound=Findings)

_CLASSES: dict[str, Callable[..., Any]] = {
    kind.__name__: kind
    for kind in (
        Atmosphere,
        Bands,
        Estimate,
        Minimum,
        Observation,
        PhaseTable,
        Prior,
        Profile,
        Setup,
        Step,
        Scan,
        *PROJECTIONS.values(),
    )
}
"""What a result is made of, by the name that stands in the file."""


def save(result: Findings, path: str | Path, *, overwrite: bool = False) -> None:
    """Write ``result``, whole or not at all. Raises :class:`FitError`, also if the file exists and ``overwrite`` is False."""
    arrays: dict[str, np.ndarray] = {}
    record = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "version": installed_version(),
        "result": {name: _pack(value, name, arrays) for name, value in _fields(result).items()},
    }
    arrays[RECORD] = np.frombuffer(json.dumps(record, allow_nan=False, ensure_ascii=False).encode(), np.uint8)
    try:
        with imageio.atomic_write(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
    except imageio.ImageError as error:
        raise FitError(str(error)) from error


def load(path: str | Path, kind: type[F]) -> F:
    """Read what :func:`save` has written, as a ``kind`` of findings.

    Raises :class:`FitError` with one line for a file that cannot be read, is something else, is damaged, or is of a version of
    diffatmo that wrote other files.
    """
    try:
        with Path(path).open("rb") as file:
            if not zipfile.is_zipfile(path):
                raise FitError(f"{path}: not a saved fit, or one that is cut short; expected a file of FitResult.save")
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, Mapping) or RECORD not in archive:
                raise FitError(f"{path}: not a saved fit, expected a file that FitResult.save has written")
            arrays = {name: archive[name] for name in archive}
    except OSError as error:
        raise FitError(f"{path}: cannot be read: {error.strerror or error}") from error
    except FitError:
        raise
    except DAMAGED as error:
        raise FitError(f"{path}: not a saved fit, or one that is damaged or cut short ({_line(error)})") from error
    try:
        record = json.loads(arrays[RECORD].tobytes())
        if record["schema"] != SCHEMA:
            raise ValueError(f"schema: got {record['schema']!r}, expected {SCHEMA!r}")
        if record["schema_version"] != SCHEMA_VERSION:
            by = f"diffatmo {record['version']}"
            raise ValueError(f"schema_version: got {record['schema_version']} ({by}), expected {SCHEMA_VERSION}")
        return kind(**{name: _unpack(value, arrays) for name, value in record["result"].items()})
    except DAMAGED as error:
        raise FitError(f"{path}: not a fit as this version of diffatmo saves it: {_line(error)}") from error


def installed_version() -> str | None:
    """That of diffatmo; None in a checkout that is not installed."""
    try:
        return version("diffatmo")
    except PackageNotFoundError:
        return None


def _line(error: BaseException) -> str:
    """The first line of an error, for a message of one line."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def _fields(value: Any) -> dict[str, Any]:
    """Field by field what a dataclass, a module or a named tuple is made of."""
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return dict(value._asdict())


def _pack(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """``value`` as JSON holds it, with its arrays put into ``arrays``; ``name`` is its place in the result."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return {"type": "float", "value": str(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | jax.Array):
        arrays[name] = np.asarray(value)
        return {"type": "array", "name": name}
    if isinstance(value, Model):
        known = [key for key, kind in MODELS.items() if type(value) is kind]
        return {"type": "model", "name": known[0], "fields": _pack(_fields(value), name, arrays)} if known else None
    if _CLASSES.get(type(value).__name__) is type(value):
        return {"type": type(value).__name__} | {k: _pack(v, f"{name}.{k}", arrays) for k, v in _fields(value).items()}
    if isinstance(value, dict):
        return {"type": "dict", "items": {key: _pack(item, f"{name}.{key}", arrays) for key, item in value.items()}}
    if isinstance(value, list | tuple):
        return [_pack(item, f"{name}.{number}", arrays) for number, item in enumerate(value)]
    raise TypeError(f"{name}: a {type(value).__name__} cannot be saved")


def _unpack(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The inverse of :func:`_pack`, but that a tuple comes back as a list."""
    if isinstance(value, list):
        return [_unpack(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    rest = {key: item for key, item in value.items() if key != "type"}
    kind = value["type"]
    if kind == "float":
        return float(rest["value"])
    if kind == "array":
        return arrays[rest["name"]]
    if kind == "dict":
        return {key: _unpack(item, arrays) for key, item in rest["items"].items()}
    if kind == "model":
        return _unpack_model(rest["name"], _unpack(rest["fields"], arrays))
    if kind not in _CLASSES:
        raise ValueError(f"type: got {kind!r}, which is not part of a fit")
    return _CLASSES[kind](**{key: _unpack(item, arrays) for key, item in rest.items()})


def _unpack_model(name: str, fields: Mapping[str, Any]) -> Model:
    """A model of diffatmo's; resolutions that are tuples have the class of the default ones."""
    default: Any = MODELS[name]()
    values: dict[str, Any] = {}
    for key, value in fields.items():
        kind = type(getattr(default, key))
        values[key] = getattr(kind, "_make", kind)(value) if isinstance(value, list) else value
    return MODELS[name](**values)
