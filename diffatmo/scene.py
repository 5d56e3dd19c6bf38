"""Pictures that carry their scene: an EXR whose header holds everything it was made from.

The attribute ``diffatmo`` of the header is TOML text: ``version``, the scene's numbers, a ``[camera]`` table, an
``[atmosphere]`` table (the keys of an atmosphere file), and whatever else its maker noted under ``[notes]`` (the model,
the noise, ...). Text, because numbers in an EXR header have single precision and here nothing may be lost.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import tomli_w
from jaxtyping import Float

from diffatmo import atmosphere, camera, imageio, sun
from diffatmo.numerics import array
from diffatmo.render import Scene

ATTRIBUTE = "diffatmo"
"""Name of the header attribute."""

VERSION = 1


class Shot(NamedTuple):
    """A picture read back with its scene."""

    pixels: Float[np.ndarray, "height width w"]
    scene: Scene
    notes: dict[str, Any]


def dumps(scene: Scene, notes: Mapping[str, Any] | None = None) -> str:
    """A scene as TOML text; :func:`loads` gives the same bits back. The angles of the sun are for the reader's eye."""
    zenith, azimuth = sun.angles(scene.sun)
    return tomli_w.dumps(
        {
            "version": VERSION,
            "altitude_km": _shortest(scene.altitude),
            "sun_zenith_deg": round(float(jnp.degrees(zenith)), 6),
            "sun_azimuth_deg": round(float(jnp.degrees(azimuth)), 6),
            "sun_direction": [_shortest(component) for component in scene.sun],
            "exposure": _shortest(scene.exposure),
            "camera": camera.to_dict(scene.camera),
            "atmosphere": atmosphere.to_dict(scene.atmosphere),
            "notes": dict(notes or {}),
        }
    )


def _shortest(value: Any) -> float:
    """The decimal with the fewest digits that reads back as the same number in the same precision."""
    return float(str(np.asarray(value)[()]))


def loads(text: str) -> tuple[Scene, dict[str, Any]]:
    """A scene and the notes beside it from TOML text. Raises ``ValueError`` with one line on what is wrong."""
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not TOML: {error}") from error
    try:
        return _scene(data)
    except (TypeError, OverflowError, RecursionError) as error:
        # Of the wrong type, too large for a number, nested without end: nothing that diffatmo has written.
        raise ValueError(f"not a scene: {error}") from error


def _scene(data: dict[str, Any]) -> tuple[Scene, dict[str, Any]]:
    if data.get("version") != VERSION:
        raise ValueError(f"version: got {data.get('version')!r}, expected {VERSION}")
    missing = [key for key in _KEYS if key not in data]
    if missing:
        raise ValueError(f"{missing[0]}: missing")
    wrong = [key for key, kind in _KEYS.items() if not isinstance(data[key], kind) or isinstance(data[key], bool)]
    if wrong:
        raise ValueError(f"{wrong[0]}: got {data[wrong[0]]!r}, expected {_WANTED[_KEYS[wrong[0]]]}")
    towards = data["sun_direction"]
    if len(towards) != 3 or not all(isinstance(item, int | float) for item in towards):
        raise ValueError(f"sun_direction: got {towards!r}, expected three numbers")
    scene = Scene(
        atmosphere=atmosphere.from_dict(data["atmosphere"]),
        camera=camera.from_dict(data["camera"]),
        altitude=array(data["altitude_km"]),
        sun=array(towards),
        exposure=array(data["exposure"]),
    )
    notes = data.get("notes", {})
    if not isinstance(notes, dict):
        raise ValueError(f"notes: got {notes!r}, expected a table")
    return scene, notes


_KEYS: dict[str, Any] = {
    "altitude_km": int | float,
    "exposure": int | float,
    "sun_direction": list,
    "camera": dict,
    "atmosphere": dict,
}
_WANTED: dict[Any, str] = {int | float: "a number", list: "three numbers", dict: "a table"}


def save(
    path: str | Path,
    pixels: Float[np.ndarray, "height width w"],
    scene: Scene,
    *,
    notes: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write pixels (radiance times the scene's exposure) as EXR with the scene in its header.

    ``notes`` are plain TOML values: ``{"model": "moments", "noise": 0.01}``. Raises
    :class:`diffatmo.imageio.ImageError`.
    """
    size = (scene.camera.height, scene.camera.width, scene.atmosphere.wavelengths.size)
    if np.shape(pixels) != size:
        raise imageio.ImageError(f"{path}: pixels of shape {np.shape(pixels)}, expected {size} like the scene")
    imageio.write_exr(
        path,
        pixels,
        {ATTRIBUTE: dumps(scene, notes)},
        wavelengths=np.asarray(scene.atmosphere.wavelengths),
        overwrite=overwrite,
    )


def load(path: str | Path) -> Shot:
    """Read an EXR written by :func:`save`. Raises :class:`diffatmo.imageio.ImageError`."""
    image = imageio.read_image(path)
    if ATTRIBUTE not in image.metadata:
        raise imageio.ImageError(
            f"{path}: no attribute {ATTRIBUTE!r} in the header, expected an EXR rendered by diffatmo"
        )
    return from_image(path, image)


def from_image(path: str | Path, image: imageio.Image) -> Shot:
    """The scene of a picture that was read already and has the attribute; ``path`` is named in errors."""
    try:
        scene, notes = loads(str(image.metadata[ATTRIBUTE]))
    except ValueError as error:
        raise imageio.ImageError(f"{path}: scene in the header: {error}") from error
    size = (scene.camera.height, scene.camera.width, scene.atmosphere.wavelengths.size)
    if image.pixels.shape != size:
        raise imageio.ImageError(f"{path}: pixels of shape {image.pixels.shape}, but its header says {size}")
    return Shot(image.pixels, scene, notes)
