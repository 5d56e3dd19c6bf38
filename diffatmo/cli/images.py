"""From an image file, and what is said about it, to an observation that can be fitted."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from diffatmo.cli import bracket
from diffatmo.cli.common import InputError
from diffatmo.cli.keys import CAMERA_KEYS, flag_of, make_camera, with_sun
from diffatmo.cli.photo import (
    GLOW_ERROR_DEG,
    MAX_PIXELS,
    SATURATION,
    SUN_SEEN,
    channels,
    check_colour,
    complete,
    find_mask,
    is_photo,
    shared_noise,
)
from diffatmo.cli.scenefile import LOWEST_SUN_DEG, ImageSpec, check_image_options

if TYPE_CHECKING:
    import numpy as np

    from diffatmo.atmosphere import Atmosphere
    from diffatmo.camera import Camera
    from diffatmo.imageio import Image
    from diffatmo.scene import Shot
    from fitting import Observation

NOISE_KEYS = ("noise", "noise_shot", "noise_floor")
"""Also looked for among the notes in an image's header."""

NUMBERS_AND_NAMES = (
    "exposure",
    "white_balance",
    "pedestal",
    "sun_offset",
    "pose",
    "focal",
    "focal_error",
    "vignetting",
    "vignetting_error",
    "tone",
    "tone_error",
    "chroma",
    "chroma_error",
    "aerosol",
    "aerosol_error",
    "aerosol_memory_h",
    "time_h",
    "saturation",
)
ANGLES = (
    "view_zenith_max_deg",
    "sun_exclusion_deg",
    "horizon_exclusion_deg",
    "sun_offset_error_deg",
    "pose_error_deg",
    "heading_error_deg",
)
"""What :func:`fitting.observe` takes as it is, and what it takes in radians."""

EXCLUDING = ("pedestal", "noise_floor", "saturation", "sun_exclusion", "view_zenith_max", "horizon_exclusion")
"""What of it says which pixels are left out."""

MOST_SHOWN = 2048
"""Pixels of the longer side of a photo that is kept to be looked at."""

EXPONENT_ERROR = 0.03
"""Of a transfer function that a bracket confirms: over a factor of 5 that is the 5 % by which a photo is off anyway."""

COLOUR_KEYS = ("camera_matrix", "sensitivities")
"""What is said of channels that are bands."""

SAME_WAVELENGTH_NM = 0.01


class Opened(NamedTuple):
    """An image as it was read."""

    spec: ImageSpec
    """Of a bracket, what it says of the merged picture."""
    image: "Image"
    shot: "Shot | None"
    encoded: bool
    """Whether it is not linear, and nobody has said by which transfer function; that of sRGB was undone."""
    told: tuple[str, ...] = ()
    """What was merged, in words."""

    @property
    def photo(self) -> bool:
        """Whether its channels are bands (:mod:`diffatmo.cli.photo`)."""
        return self.shot is None and is_photo(self.image)


class View(NamedTuple):
    """A photo as it is looked at: its pixels, and those that are left out of the fit."""

    pixels: "np.ndarray"
    """Linear, red, green and blue."""
    left_out: "Mapping[str, np.ndarray]"
    """By reason (:func:`fitting.observation.exclusions`)."""
    own_mask: bool
    """Whether the user said which pixels are sky."""


class Seen(NamedTuple):
    """An image to be fitted, and what its header says about where it comes from."""

    observation: "Observation"
    truth: "Atmosphere | None" = None
    model: str | None = None
    """That rendered it."""
    assumed: tuple[str, ...] = ()
    """What was merged, and what was assumed of a photo, in words."""
    view: View | None = None
    """Of a photo."""


def open_image(spec: ImageSpec, *, may_be_photo: bool) -> Opened:
    """Read an image and its header; merge those of a bracket."""
    views = [_open_file(file, spec.options, may_be_photo=may_be_photo) for file in spec.files]
    if len(views) == 1:
        return Opened(spec, *views[0])
    options = {key: value for key, value in spec.options.items() if key not in bracket.OWN_KEYS}
    shot, known = _common_shot(spec.files, [view.shot for view in views])
    merged = bracket.merge(spec.files, [view.image for view in views], spec.options, known)
    options["saturation"] = merged.image.saturation
    encoded, told = any(view.encoded for view in views), [merged.told]
    guessed = any(view.image.taken_as_linear for view in views)
    if (encoded or guessed) and merged.exponent_error is not None and merged.exponent_error < EXPONENT_ERROR:
        told.append(f"transfer function: {'that of sRGB' if encoded else 'linear'}, by which the exposures agree")
        encoded = guessed = False
    image = merged.image._replace(taken_as_linear=guessed)
    return Opened(replace(spec, options=options), image, shot, encoded, tuple(told))


class _View(NamedTuple):
    """What is in one file."""

    image: "Image"
    shot: "Shot | None"
    encoded: bool


def _open_file(file: Path, options: Mapping[str, Any], *, may_be_photo: bool) -> _View:
    from diffatmo import imageio, scene

    encoded = False
    try:
        image = imageio.read_image(file, transfer=options.get("transfer"))
    except imageio.EncodedError:
        if not may_be_photo:
            raise
        image, encoded = imageio.read_image(file, transfer="srgb"), True
    shot = scene.from_image(file, image) if scene.ATTRIBUTE in image.metadata else None
    return _View(image, shot, encoded)


def _common_shot(files: Sequence[Path], shots: "Sequence[Shot | None]") -> "tuple[Shot | None, list[float] | None]":
    """The scene that several exposures have in common, per unit of exposure, and the exposure of each, or neither."""
    import jax.numpy as jnp

    from diffatmo import scene

    if not any(shots):
        return None, None
    alike = [shot and shot._replace(scene=replace(shot.scene, exposure=jnp.ones(()))) for shot in shots]
    told = [shot and scene.dumps(shot.scene) for shot in alike]
    for file, text in zip(files, told, strict=True):
        if text != told[0]:
            raise InputError(f"{file}: another scene in its header than {files[0]}; expected exposures of one view")
    return alike[0], [float(shot.scene.exposure) for shot in shots if shot]


def _with_known(noise: "np.ndarray | None", chosen: Mapping[str, Any]) -> dict[str, Any]:
    """What goes to :func:`fitting.observe`, with a ``noise`` of pixels that is known: a relative error comes on top of it."""
    import numpy as np

    if noise is None:
        return dict(chosen)
    others = {key: value for key, value in chosen.items() if key not in NOISE_KEYS}
    return others | {"noise": np.hypot(noise, chosen.get("noise", 0.0))}


def observe_photo(opened: Opened, name: str) -> Seen:
    """The photo as an observation called ``name``, with what it does not say taken from it or assumed."""
    import numpy as np

    import fitting
    from diffatmo import sun
    from fitting.observation import exclusions

    spec = opened.spec
    try:
        photo = complete(opened.image, spec.options, opened.encoded)
        check_image_options(photo.options)
        options = photo.options
        camera = find_camera(options, photo.pixels, None)
        seeing, of_colours = channels(options)
        assumed = [*opened.told, *of_colours, *photo.assumed]
        towards, seen = _sun_of(photo.pixels, camera, options, stated="sun" in spec.options)
        check_colour(photo.pixels)
        if not seen:
            options = {"sun_offset": "free", "sun_offset_error_deg": GLOW_ERROR_DEG} | options
            zenith, azimuth = np.degrees(sun.angles(towards))
            where = f"{zenith:.0f}° from the zenith at azimuth {azimuth:.0f}°"
            assumed = [line for line in assumed if line != SUN_SEEN]
            assumed.append(
                f"the sun is clipped or hidden: {where} ± {GLOW_ERROR_DEG:g}°, where the sky is brightest; fitted"
            )
        if "mask" in options:
            mask: Any = read_mask(Path(options["mask"]))
        else:
            found = find_mask(photo.pixels, camera, towards, options)
            mask = {reason: found.label == number for number, reason in enumerate(found.reasons) if number}
        chosen = stated(options)
        seen_from: dict[str, Any] = {"camera": camera, "sun": np.asarray(towards), "mask": mask}
        observation = fitting.observe(
            photo.pixels,
            **seen_from,
            altitude=options["altitude_km"],
            bands=seeing,
            max_pixels=MAX_PIXELS,
            name=name,
            merged=len(spec.files),
            **_with_known(photo.noise, chosen),
        )
    except ValueError as error:
        raise InputError(f"{spec.file}: {str(error).removeprefix(f'{name}: ')}") from error
    if "noise" not in spec.options:
        observation = replace(observation, noise=shared_noise(observation))
    left_out = exclusions(photo.pixels, **seen_from, **{key: chosen[key] for key in EXCLUDING if key in chosen})
    # A photo with a mask has all its pixels; more than a screen has are not looked at.
    few = slice(None, None, max(1, max(photo.pixels.shape) // MOST_SHOWN))
    view = View(photo.pixels[few, few], {reason: bad[few, few] for reason, bad in left_out.items()}, "mask" in options)
    return Seen(observation, assumed=tuple(assumed), view=view)


def _sun_of(
    pixels: "np.ndarray", camera: "Camera", options: Mapping[str, Any], *, stated: bool
) -> "tuple[np.ndarray, bool]":
    """The sun of a photo, and whether it is seen, or known; if not, it is looked for where a whole sky is brightest.

    Where it was ``stated`` that the picture shows the sun, it is refused if it does not.
    """
    from diffatmo import sun
    from diffatmo.cli.photo import glow

    try:
        return find_sun(options, pixels, camera, None), True
    except sun.SunError as error:
        if stated:
            raise
        found = glow(pixels, camera)
        if found is not None:
            return found, False
        place = ", ".join(map(flag_of, ("time", "latitude_deg", "longitude_deg")))
        raise InputError(
            f"{error}; give {flag_of('sun_zenith_deg')} and {flag_of('sun_azimuth_deg')}, or {place}"
        ) from error


def stated(options: Mapping[str, Any]) -> dict[str, Any]:
    """What of ``options`` goes to :func:`fitting.observe` as it is, or in radians."""
    chosen = {key: options[key] for key in (*NUMBERS_AND_NAMES, *NOISE_KEYS) if key in options}
    return chosen | {key.removesuffix("_deg"): math.radians(options[key]) for key in ANGLES if key in options}


def observe(opened: Opened, name: str, init: "Atmosphere") -> Seen:
    """The image as an observation called ``name``.

    What its options do not say is taken from its header; what neither says is asked for.
    """
    import fitting

    spec, image, shot = opened.spec, opened.image, opened.shot
    options = spec.options
    try:
        check_image_options(options)
        for key in COLOUR_KEYS:
            if key in options:
                raise InputError(
                    f"{key}: the channels are wavelengths of the atmosphere, expected a photo without --init"
                )
        order = order_of(image, init)
        pixels = image.pixels[..., order]
        noise = None if image.noise is None else image.noise[..., order]
        camera, altitude = find_camera(options, pixels, shot), find_altitude(options, shot)
        notes = shot.notes if shot else {}
        chosen = {key: notes[key] for key in NOISE_KEYS if key in notes} | stated(options)
        if image.saturation is not None:
            chosen.setdefault("saturation", SATURATION * image.saturation)
        observation = fitting.observe(
            pixels,
            camera=camera,
            altitude=altitude,
            sun=find_sun({**options, "altitude_km": altitude}, pixels, camera, shot),
            mask=read_mask(Path(options["mask"])) if "mask" in options else None,
            exposure_value=float(shot.scene.exposure) if shot else 1.0,
            name=name,
            merged=len(spec.files),
            **_with_known(noise, chosen),
        )
    except ValueError as error:
        raise InputError(f"{spec.file}: {str(error).removeprefix(f'{name}: ')}") from error
    told = list(opened.told)
    if noise is None and not any(key in chosen for key in NOISE_KEYS):
        told.append(f"noise of 1 % of the light, as nothing says what it is: {flag_of('noise')}")
    return Seen(observation, truth_of(shot, init) if shot else None, notes.get("model"), tuple(told))


def order_of(image: "Image", init: "Atmosphere") -> "np.ndarray":
    """The indices that put the channels of a picture into the order of the atmosphere's wavelengths."""
    import numpy as np

    wanted = np.asarray(init.wavelengths, dtype=float)
    count = image.pixels.shape[-1]
    if count != wanted.size:
        channels = "1 channel" if count == 1 else f"{count} channels"
        raise InputError(f"{channels}, but the atmosphere of the fit has {wanted.size} wavelengths ({_list(wanted)})")
    if image.wavelengths is not None:
        own = np.asarray(image.wavelengths, dtype=float)
        order = matching(own, wanted)
        if np.any(np.abs(own[order] - wanted) > SAME_WAVELENGTH_NM):
            raise InputError(
                f"wavelengths {_list(own)}, but the atmosphere of the fit has {_list(wanted)}; expected an init (--init) "
                "with the wavelengths of the image"
            )
    elif count == 3:
        # Red, green, blue: the longest wavelength first.
        order = matching(np.array([3, 2, 1]), wanted)
    else:
        order = np.arange(count)
    return order


def matching(own: "np.ndarray", wanted: "np.ndarray") -> "np.ndarray":
    """The indices that put numbers ranked like ``own`` into the ranks of ``wanted``."""
    import numpy as np

    return np.argsort(own)[np.argsort(np.argsort(wanted))]


def truth_of(shot: "Shot", init: "Atmosphere") -> "Atmosphere":
    """The atmosphere that a picture carries, in the order of the wavelengths of ``init``."""
    import numpy as np

    from diffatmo.atmosphere import SPECTRAL

    truth = shot.scene.atmosphere
    order = matching(np.asarray(truth.wavelengths), np.asarray(init.wavelengths))
    return replace(truth, **{name: np.asarray(getattr(truth, name))[order] for name in SPECTRAL})


def find_camera(options: Mapping[str, Any], pixels: "np.ndarray", shot: "Shot | None") -> "Camera":
    """The camera that took the picture."""
    from diffatmo import camera

    described = {key: options[key] for key in CAMERA_KEYS if key in options}
    if shot and not described:
        return shot.scene.camera
    if shot and described.get("projection") in (None, camera.to_dict(shot.scene.camera)["projection"]):
        described = camera.to_dict(shot.scene.camera) | described
    elif "projection" not in described:
        raise _unknown("projection")
    height, width = pixels.shape[:2]
    if described["projection"] == "equirectangular":
        if "upper" not in described:
            described["upper"] = width == 4 * height
        if width != 2 * height and not (described["upper"] and width == 4 * height):
            shapes = "2:1, or 4:1 if it ends at the horizon"
            raise InputError(f"{width} x {height} pixels, expected {shapes}, for projection equirectangular")
    return make_camera(described, height=height, width=width)


def find_altitude(options: Mapping[str, Any], shot: "Shot | None") -> float:
    """Where the picture was taken, km above the ground."""
    if "altitude_km" in options:
        return options["altitude_km"]
    if shot is None:
        raise _unknown("altitude_km")
    return float(shot.scene.altitude)


def find_sun(options: Mapping[str, Any], pixels: "np.ndarray", camera: "Camera", shot: "Shot | None") -> "np.ndarray":
    """Unit vector to the sun."""
    import numpy as np

    from diffatmo import sun

    if "sun" in options:
        return sun.find(pixels, camera).direction
    if "time" in options:
        options = with_sun(options)
        if options["sun_zenith_deg"] > LOWEST_SUN_DEG:
            below = options["sun_zenith_deg"] - 90
            raise InputError(f"time: the sun is {below:.1f} degrees below the horizon then, expected at most 18")
    keys = ("sun_zenith_deg", "sun_azimuth_deg")
    known: dict[str, float] = {}
    if shot:
        known = dict(zip(keys, np.degrees(sun.angles(shot.scene.sun)).tolist(), strict=True))
        if not any(key in options for key in keys):
            return np.asarray(shot.scene.sun)
    known |= {key: options[key] for key in keys if key in options}
    for key in keys:
        if key not in known:
            raise _unknown(key)
    zenith, azimuth = (math.radians(known[key]) for key in keys)
    return np.asarray(sun.direction(zenith=zenith, azimuth=azimuth))


def read_mask(path: Path) -> "np.ndarray":
    """True where the picture is not black."""
    import numpy as np

    from diffatmo import imageio

    return np.any(imageio.read_image(path, transfer="linear").pixels > 0, axis=-1)


def _unknown(key: str) -> InputError:
    return InputError(f"{key} is not in the image's header: give {flag_of(key)}, or {key} in a scene file")


def _list(wavelengths: "np.ndarray") -> str:
    return ", ".join(f"{nm:g}" for nm in wavelengths) + " nm"
