"""What is to be fitted, as the user describes it: a scene file, or images with options."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from diffatmo._names import did_you_mean
from diffatmo.cli.common import InputError
from diffatmo.cli.keys import (
    CAMERA_KEYS,
    PLACE_KEYS,
    Key,
    Number,
    Numbers,
    Word,
    check_camera_options,
    check_sun_options,
    read,
)

FREE = (
    "rayleigh_scattering",
    "rayleigh_scale_height",
    "mie_scattering",
    "mie_absorption",
    "mie_scale_height",
    "mie_g",
    "ozone_absorption",
    "ground_albedo",
)
"""Parameters that are free unless the user says otherwise."""

LOWEST_SUN_DEG = 108
"""Zenith angle of the lowest sun whose sky is fitted."""

IMAGE_KEYS: dict[str, Key] = {
    **CAMERA_KEYS,
    **PLACE_KEYS,
    "sun_zenith_deg": Number("Zenith angle of the sun; above 90 it is below the horizon.", 0, LOWEST_SUN_DEG),
    "sun": Word("Find the sun in the picture.", ("detect",)),
    "exposure": Word(
        "fixed, free, free-per-channel, or the name of a group of images that share one.  [default: fixed]"
    ),
    "white_balance": Word("fixed, free, or the name of a group of images that share one.  [default: fixed]"),
    "pedestal": Word(
        "Black level in units of the image: fixed, free, free-per-channel, or the name of a group.  [default: fixed]"
    ),
    "sun_offset": Word(
        "The sun may be off by two small angles: fixed, free, or the name of a group.  [default: fixed]"
    ),
    "sun_offset_error_deg": Number("Standard deviation of each of them.  [default: 0.5]", 0, 30, positive=True),
    "pose": Word(
        "The camera may be turned by a small rotation: fixed, free, or the name of a group.  [default: fixed]"
    ),
    "pose_error_deg": Number("Standard deviation of each of its angles.  [default: 2]", 0, 30, positive=True),
    "heading_error_deg": Number("Of the turn about the vertical.  [default: as pose_error_deg]", 0, 57, positive=True),
    "focal": Word("The focal length may be off by a factor: fixed, free, or the name of a group.  [default: fixed]"),
    "focal_error": Number("Standard deviation of its logarithm.  [default: 0.05]", 0, 1, positive=True),
    "vignetting": Word("The lens may darken the corners: fixed, free, or the name of a group.  [default: fixed]"),
    "vignetting_error": Number("Standard deviation of its two coefficients.  [default: 0.5]", 0, 1, positive=True),
    "tone": Word(
        "Pixels may have been through another tone curve: fixed, free, or the name of a group.  [default: fixed]"
    ),
    "tone_error": Number("Standard deviation of its three coefficients.  [default: 0.15]", 0, 1, positive=True),
    "chroma": Word("Colours may be purer or paler: fixed, free, or the name of a group.  [default: fixed]"),
    "chroma_error": Number("Standard deviation of its coefficient.  [default: 0.2]", 0, 1, positive=True),
    "aerosol": Word(
        "There may be more or less aerosol than the atmosphere's: fixed, free, or the name of a group.  [default: fixed]"
    ),
    "aerosol_error": Number("Standard deviation of the logarithm of that factor.  [default: 0.3]", 0, 1, positive=True),
    "aerosol_memory_h": Number("Hours in which the aerosol changes.  [default: 6]", 0, positive=True),
    "time_h": Number("Hours from any moment that all images share; for the aerosol's change."),
    "noise": Number("Relative standard deviation per pixel and channel.  [default: 0.01]", 0, 1),
    "noise_shot": Number("Variance per unit of signal (photon noise).  [default: 0]", 0, 1e30),
    "noise_floor": Number("Standard deviation of a dark pixel (read noise).  [default: 1e-4 of the median]", 0, 1e30),
    "saturation": Number(
        "Leave out pixels with a channel at or above this value.  [default: 0.98 of what the file can hold]",
        0,
        positive=True,
    ),
    "view_zenith_max_deg": Number(
        "Use pixels up to this zenith angle: 90 the sky, 180 the ground too.  [default: 90]", 0, 180, True
    ),
    "sun_exclusion_deg": Number("Leave out pixels nearer to the sun.  [default: 2]", 0, 179),
    "horizon_exclusion_deg": Number("Leave out pixels nearer to the horizon.  [default: 0]", 0, 89),
    "mask": Word("A picture that is black where pixels are to be left out."),
    "transfer": Word("Transfer function of a picture that is not linear.", ("srgb", "linear")),
    "exposure_s": Numbers(
        "Of a bracket: how long each file was exposed, in s.  [default: from Exif, with ISO and f-number]",
        "numbers above 0, one for each file, like 0.001, 0.008",
    ),
    "camera_matrix": Numbers(
        "Of a photo: what takes its red, green, blue to CIE XYZ, row by row.  [default: RAW: its own; else that of sRGB]",
        "nine numbers, row by row, like 0.41, 0.36, 0.18, 0.21, 0.72, 0.07, 0.02, 0.12, 0.95",
        9,
    ),
    "sensitivities": Word(
        "Of a photo, instead: a table (CSV) of what its channels see, wavelength_nm, red, green, blue."
    ),
}
"""The keys of an ``[[image]]``, each also an option of the command line."""

MODELS = ("moments", "bruneton", "hillaire", "raymarch")
"""The models that have derivatives."""

LOSSES = ("huber", "cauchy", "tukey")
"""Those of ``fitting.robust``, which takes seconds to import; a test compares the two."""

PRIOR_KEYS: dict[str, dict[str, Key]] = {
    "number": {
        "name": Word("A parameter or derived quantity, with _<nm> for one wavelength of it."),
        "value": Number("What it is thought to be."),
        "error": Number("Standard deviation.", 0, positive=True),
        "relative_error": Number("Standard deviation of the logarithm, instead.", 0, positive=True),
    },
    "molecular": {
        "pressure_hpa": Number("At the ground.  [default: 1013.25]", 0, positive=True),
        "temperature_k": Number("At the ground.  [default: 288.15]", 0, positive=True),
    },
    "ozone": {
        "latitude_deg": Number("Of the place.", -90, 90),
        "longitude_deg": Number("Of the place, east positive.", -180, 180),
        "day_of_year": Number("From 1.", 1, 366),
    },
    "aerosol": {"type": Word("As in OPAC, like continental average.")},
}
"""The keys of a ``[[prior]]`` by its kind; ``number`` is that of a table without ``kind``."""

SCENE_KEYS = ("init", "free", "tie", "prior", "loss", "model", "max_steps", "starts", "profile", "image")


@dataclass(frozen=True)
class ImageSpec:
    """One image to be fitted; ``options`` holds the ``IMAGE_KEYS`` that were given, its header gives the rest."""

    file: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    others: tuple[Path, ...] = ()
    """Of a bracket: the files of the other exposures."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All of its files."""
        return (self.file, *self.others)


@dataclass(frozen=True)
class FitSpec:
    """One fit: the images, where it starts, and which parameters are free. None: not said."""

    images: tuple[ImageSpec, ...]
    init: str | None = None
    free: tuple[str, ...] | None = None
    tie: Mapping[str, str] | None = None
    priors: tuple[Mapping[str, Any], ...] | None = None
    """Tables of the keys of :data:`PRIOR_KEYS`, each complete."""
    loss: str | None = None
    model: str | None = None
    max_steps: int | None = None
    starts: int | None = None
    profile: tuple[str, ...] | None = None

    def override(self, **given: Any) -> "FitSpec":
        """This fit with what is not None in ``given`` put in its place."""
        return replace(self, **{key: value for key, value in given.items() if value is not None})


def check_image_options(options: Mapping[str, Any], *, complete: bool = True) -> None:
    """Refuse options of one image that contradict each other; ``complete`` ones have nothing added by what is in the file."""
    check_sun_options(options, complete=complete)
    check_camera_options(options)
    if "camera_matrix" in options and "sensitivities" in options:
        raise InputError("sensitivities contradicts camera_matrix: give one or the other")


def bracket(files: Sequence[Path], options: Mapping[str, Any]) -> ImageSpec:
    """One image of several files, or of one; refuses exposures that are not theirs."""
    exposures = options.get("exposure_s")
    if exposures is not None and len(files) < 2:
        raise InputError(
            'exposure_s: of one file, expected a bracket: several files with --bracket, or file = ["a.jpg", "b.jpg"] in a '
            "scene file"
        )
    if exposures is not None and len(exposures) != len(files):
        raise InputError(f"exposure_s: got {len(exposures)} numbers for {len(files)} files, expected one for each")
    return ImageSpec(files[0], options, tuple(files[1:]))


def read_scene(path: Path, *, least: int = 1) -> FitSpec:
    """Read a scene file with at least so many images; relative paths in it are relative to it."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is not a file, expected a scene file")
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a TOML file: {error}") from error
    try:
        return _scene(data, path.parent, least)
    except OverflowError as error:
        raise InputError(f"{path}: a number is too large: {error}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _scene(data: Mapping[str, Any], directory: Path, least: int) -> FitSpec:
    if "wavelengths_nm" in data and "image" not in data:
        raise InputError("an atmosphere, expected a scene file, which names an atmosphere under init")
    _refuse_unknown(data, SCENE_KEYS)
    tables = data.get("image", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise InputError("image: expected [[image]] tables")
    if len(tables) < least:
        raise InputError(f"image: got {len(tables)} [[image]] tables, expected at least {least}")
    images = []
    for number, table in enumerate(tables, start=1):
        try:
            images.append(_image(table, directory))
        except InputError as error:
            raise InputError(f"image {number}: {error}") from error
    init = data.get("init")
    if init is not None:
        if not isinstance(init, str):
            raise InputError(f"init: got {init!r}, expected an atmosphere file or the name of a preset")
        # A file beside the scene comes before a preset of the same name.
        init = str(directory / init) if (directory / init).exists() or init.endswith(".toml") else init
    model = data.get("model")
    if model is not None:
        model = read(Word("How the sky is computed.", MODELS), "model", model)
    max_steps, starts = _count(data, "max_steps"), _count(data, "starts")
    loss = data.get("loss")
    if loss is not None:
        loss = read(Word("What outliers are given.", LOSSES), "loss", loss)
    free, tie, priors = _names(data, "free"), _tie(data.get("tie")), _priors(data.get("prior"))
    return FitSpec(tuple(images), init, free, tie, priors, loss, model, max_steps, starts, _names(data, "profile"))


def _image(table: Mapping[str, Any], directory: Path) -> ImageSpec:
    _refuse_unknown(table, ("file", *IMAGE_KEYS))
    file = table.get("file")
    files = file if isinstance(file, list) else [file]
    names = [name for name in files if isinstance(name, str) and name]
    if names != files or len(names) < (2 if isinstance(file, list) else 1):
        raise InputError("file: expected the name of an image file, or a list of those of several exposures")
    options = {key: read(IMAGE_KEYS[key], key, value) for key, value in table.items() if key != "file"}
    for key in ("mask", "sensitivities"):
        if key in options:
            options[key] = str(directory / options[key])
    check_image_options(options, complete=False)
    return bracket([directory / name for name in names], options)


def _count(data: Mapping[str, Any], key: str) -> int | None:
    number = data.get(key)
    if number is not None and (isinstance(number, bool) or not isinstance(number, int) or number < 1):
        raise InputError(f"{key}: got {number!r}, expected a whole number of at least 1")
    return number


def _names(data: Mapping[str, Any], key: str) -> tuple[str, ...] | None:
    names = data.get(key)
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{key}: got {names!r}, expected a list of parameter names")
    return tuple(names)


def _tie(tie: Any) -> dict[str, str] | None:
    if tie is not None and not (isinstance(tie, dict) and all(isinstance(kind, str) for kind in tie.values())):
        raise InputError(f'tie: got {tie!r}, expected a table like {{ mie = "angstrom", ground_albedo = "grey" }}')
    return tie


def _priors(tables: Any) -> tuple[Mapping[str, Any], ...] | None:
    if tables is None:
        return None
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise InputError("prior: expected [[prior]] tables")
    try:
        return tuple(_prior(table) for table in tables)
    except InputError as error:
        raise InputError(f"prior: {error}") from error


def _prior(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """One ``[[prior]]``, with its kind."""
    kinds = tuple(PRIOR_KEYS)[1:]
    kind = read(Word("", kinds), "kind", table["kind"]) if "kind" in table else "number"
    keys = PRIOR_KEYS[kind]
    given = {key: value for key, value in table.items() if key != "kind"}
    _refuse_unknown(given, tuple(keys))
    values = {key: read(keys[key], key, value) for key, value in given.items()}
    if kind == "number" and ("error" in values) == ("relative_error" in values):
        raise InputError("expected one of error and relative_error")
    needed = {"number": ("name", "value"), "molecular": ()}.get(kind, tuple(keys))
    for key in needed:
        if key not in values:
            raise InputError(f"{key}: missing, expected {keys[key].expected}")
    return {"kind": kind, **values}


def _refuse_unknown(table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            raise InputError(f"{key}: unknown key{did_you_mean(key, known) or ';'} known are {', '.join(known)}")
