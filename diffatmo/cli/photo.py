"""What a photograph says itself, and what has to be assumed where it does not: ``diffatmo fit PHOTO`` with no further option.

A *photo* is a picture of three channels that diffatmo has not rendered. Its channels are bands, its exposure and white balance
are unknown, and much of it is not clear sky. Nothing that is assumed here replaces what the user says, and all of it is
reported.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from diffatmo.cli.common import InputError
from diffatmo.cli.keys import flag_of, with_sun

if TYPE_CHECKING:
    import numpy as np

    from diffatmo.atmosphere import Atmosphere
    from diffatmo.bands import Bands
    from diffatmo.camera import Camera
    from diffatmo.exif import Exif
    from diffatmo.imageio import Image
    from diffatmo.skymask import SkyMask
    from fitting import Observation

FREE = (
    "rayleigh_scattering",
    "mie_scattering",
    "mie_absorption",
    "mie_scale_height",
    "mie_g",
    "ground_albedo",
)
TIE = {"mie": "angstrom", "rayleigh_scattering": "start", "ground_albedo": "grey"}
"""What is free in a photo: three bands of an unknown white balance cannot tell more of a spectrum, nor ozone."""

LOSS = "tukey"
ERROR, PATCH_SR = 0.05, 0.15
"""Relative error of a photo and of the assumption that a sky is uniform, and the solid angle over which it is about the same,
25° across: so residuals of clear skies look. A whole sky is 40 independent numbers in each channel, however many pixels."""
MAX_PIXELS = 1000
LONGEST_SIDE = 1024
"""Of a photo, in pixels, below which it is not shrunk any further before its sky is looked for."""

EYE_LEVEL_KM = 0.002
PANORAMA_HORIZON_DEG, PHOTO_HORIZON_DEG = 10.0, 5.0
"""Elevation below which the air is not that of a uniform planet: haze in layers, hills, what was painted over a tripod."""
SUN_DEG = 15.0

PHONE_MM, PHONE_DIAGONAL_MM, OTHER_DIAGONAL_MM = 10.0, 6.9, 33.0
"""Focal length of a phone's lens at most; diagonal of the sensor of a phone, and of another camera, where Exif has no
equivalent focal length."""
FOCAL_ERROR, POSE_ERROR_DEG, HEADING_ERROR_DEG = 0.25, 3.0, 15.0
SUN_SEEN = "the sun: where it is seen in the picture"
SATURATION = 0.98
GLOW_DEG, GLOW_ERROR_DEG, BRIGHTER, TOGETHER = 5.0, 10.0, 1.5, 0.9
"""Radius of the brightest part of a sky whose sun is not seen as such, how far from its middle the sun may be, how much
brighter than the median it has to be, and the least length of the mean of its directions: that of a ring about the zenith is
the cosine of its zenith angle, that of a spot or of a twilight's arch above 0.98."""
SAME_COLOUR = 0.02
"""Standard deviation of the logarithm of red over blue below which a picture has no colours: black and white, or tinted."""
SEAM, TIMES = 0.1, 8.0
"""By how much, as a logarithm, the left and the right edge of a panorama may differ, and by how many times as much as two
columns beside each other."""
DUSK_DEG, DAYLIGHT_S = 6.0, 1e-3
"""Below the horizon by so much, the sun leaves too little light for so short an exposure, as seconds at f/1 and ISO 100."""
SCALE_HEIGHT_KM = 8.4
"""Of pressure, for the air above a place of known altitude."""


class Photo(NamedTuple):
    """A picture with all that a fit needs."""

    pixels: "np.ndarray"
    """Linear, red, green and blue."""
    noise: "np.ndarray | None"
    """Relative standard deviation of each, where it is known; the errors in ``options`` come on top."""
    options: dict[str, Any]
    """As the user could have said them."""
    assumed: list[str]
    """What was taken from the picture or from experience, in words."""


def is_photo(image: "Image") -> bool:
    """Whether a picture's channels are bands: it has three, and does not say which wavelengths they are."""
    return image.pixels.shape[-1] == 3 and image.wavelengths is None


def start(pressure_hpa: float = 1013.25, nodes: Sequence[float] | None = None) -> "Atmosphere":
    """Where the fit of a photo begins: a clear day, at the wavelengths of :mod:`diffatmo.bands`, under a sun of 1."""
    from dataclasses import replace

    import jax.numpy as jnp

    from diffatmo import atmosphere, bands, spectrum

    nodes = bands.NODES if nodes is None else nodes
    air = atmosphere.earth(nodes)
    height = 1.5
    scattering, absorption = spectrum.angstrom_aerosol(
        air.wavelengths, optical_depth_550=0.12, exponent=1.0, single_scattering_albedo=0.93, scale_height=height
    )
    return replace(
        air,
        solar_irradiance=jnp.ones(len(nodes)),
        rayleigh_scattering=air.rayleigh_scattering * (pressure_hpa / 1013.25),
        mie_scattering=scattering,
        mie_absorption=absorption,
        mie_scale_height=jnp.asarray(height),
        mie_g=jnp.asarray(0.74),
        ground_albedo=jnp.full(len(nodes), 0.15),
    )


class _Unknown(InputError):
    """Nothing tells a fact. Those of one photo are told together."""


def complete(image: "Image", options: Mapping[str, Any], encoded: bool) -> Photo:
    """Fill in what ``options`` leave out; raises :class:`InputError` for the facts that nothing tells, naming their options.

    ``encoded`` is a picture whose transfer function the user has not stated.
    """
    said, assumed = dict(options), list[str]()
    image = _srgb(image, _to_xyz(image, options))
    if "mask" not in said:
        whole, image = image, _shrunk(image)
        if image.pixels.shape != whole.pixels.shape:
            height, width = image.pixels.shape[:2]
            assumed.append(f"reduced to {width} × {height} pixels, in which all that follows is counted")
    pixels = image.pixels

    def take(key: str, value: Any, why: str = "") -> None:
        if key not in said:
            said[key] = value
            if why:
                assumed.append(why)

    unknown: list[str] = []

    def find(facts: Callable[..., None], *given: Any) -> None:
        try:
            facts(take, said, image.exif, *given)
        except _Unknown as error:
            unknown.append(str(error))

    height, width = pixels.shape[:2]
    stated = "projection" in said
    find(_take_projection, height, width)
    panorama = said["projection"] == "equirectangular"
    if panorama and not stated:
        _check_seam(pixels)
    take("altitude_km", EYE_LEVEL_KM, f"altitude above the ground: {1000 * EYE_LEVEL_KM:g} m")
    find(_take_sun, panorama)
    if said["projection"] == "pinhole":
        find(_take_heading)
        find(_take_pitch, pixels)
        take("pose", "free")
        take("pose_error_deg", POSE_ERROR_DEG)
    if unknown:
        raise InputError("; ".join(unknown))
    if not panorama:
        take("vignetting", "free")
    take("chroma", "free")
    if encoded:
        take("tone", "free", "transfer function: about that of sRGB; a smooth tone curve is fitted besides")
    elif image.taken_as_linear:
        assumed.append(
            "transfer function: taken as linear, as the file does not say; if it was developed for a screen, --transfer srgb"
        )
    if image.saturation is not None:
        take("saturation", SATURATION * image.saturation)
    if "white_balance" not in said:
        take("exposure", "free-per-channel", "exposure and white balance: unknown, fitted")
    take(
        "noise",
        ERROR,
        f"errors of the photo, and of a sky that is not uniform: {100 * ERROR:g} %, much the same within some 25°",
    )
    take("sun_exclusion_deg", SUN_DEG)
    take("horizon_exclusion_deg", PANORAMA_HORIZON_DEG if panorama else PHOTO_HORIZON_DEG)
    return Photo(pixels, image.noise, said, assumed)


def channels(options: Mapping[str, Any]) -> "tuple[Bands, list[str]]":
    """What the channels of a photo see of the spectrum, and what is known of the error of that, in words."""
    from diffatmo import bands

    if "sensitivities" not in options:
        return bands.srgb(), []
    file = options["sensitivities"]
    curves = bands.read(file)
    try:
        seen = bands.integrated(curves.values, curves.wavelengths, names=bands.COLOURS)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from error
    off = bands.node_error(curves)
    return seen, [f"colours: by {file}; the wavelengths of the model show them to {100 * off:.2g} %"]


def _to_xyz(image: "Image", options: Mapping[str, Any]) -> "np.ndarray | None":
    """What takes the colours of the picture to CIE XYZ; None where they are to stay, or are those of sRGB."""
    import numpy as np

    if "camera_matrix" in options:
        return np.reshape(options["camera_matrix"], (3, 3))
    return None if "sensitivities" in options else image.to_xyz


def _srgb(image: "Image", to_xyz: "np.ndarray | None") -> "Image":
    """Linear sRGB, white for daylight (D65), with its noise. A pixel of which a channel is clipped is clipped in all.

    Raises :class:`InputError` for a matrix that is none of a camera.
    """
    import numpy as np

    from diffatmo.color import XYZ_TO_SRGB

    if to_xyz is None:
        return image
    if np.linalg.cond(to_xyz) > 1e6:
        raise InputError("camera_matrix: its rows depend on each other, expected a matrix from RGB to CIE XYZ")
    daylight = np.linalg.solve(XYZ_TO_SRGB @ to_xyz, np.ones(3))
    if np.any(daylight <= 0):
        seen = ", ".join(f"{value:.2g}" for value in daylight)
        raise InputError(
            f"camera_matrix: daylight would be {seen} in the picture, expected numbers above 0, by a matrix from RGB to CIE XYZ"
        )
    matrix = (XYZ_TO_SRGB @ to_xyz * daylight.max()).astype(np.float32)
    pixels, noise, saturation = image.pixels @ matrix.T, image.noise, image.saturation
    if noise is not None:
        # Errors of the channels are independent, and their variances add.
        noise = _relative(np.square(noise * image.pixels) @ np.square(matrix).T, pixels)
    if saturation is not None:
        clipped = (image.pixels >= SATURATION * saturation).any(axis=-1, keepdims=True)
        # As much as a channel can have.
        saturation *= float(np.maximum(matrix, 0).sum(axis=1).max())
        pixels = np.where(clipped, np.float32(saturation), pixels)
    return image._replace(pixels=pixels, noise=noise, saturation=saturation)


def _relative(variance: "np.ndarray", pixels: "np.ndarray") -> "np.ndarray":
    """Relative standard deviation of ``pixels``; 0 of those that have no light, or are not known."""
    import numpy as np

    known = np.isfinite(variance) & np.isfinite(pixels) & (pixels > 0)
    return np.divide(np.sqrt(np.where(known, variance, 0)), pixels, out=np.zeros_like(pixels), where=known)


def check_colour(pixels: "np.ndarray") -> None:
    """Refuse a picture of one colour, whose channels tell nothing of a spectrum."""
    import numpy as np

    lit = np.isfinite(pixels).all(axis=-1) & (pixels > 0).all(axis=-1)
    ratio = np.log(pixels[lit][:, 0] / pixels[lit][:, 2])
    if ratio.size and ratio.std() < SAME_COLOUR:
        raise InputError(
            "the picture is black and white, or of one colour: red over blue is the same everywhere, expected a colour picture"
        )


def _check_seam(pixels: "np.ndarray") -> None:
    """Refuse a picture that is taken for a panorama by its shape alone, but whose edges do not meet behind the camera."""
    import numpy as np

    # The upper quarter, above most buildings, whose edge might be there.
    light = np.log(np.maximum(pixels[: len(pixels) // 4].mean(axis=-1), 1e-30))
    light = light[np.isfinite(light).all(axis=1)]
    if not light.size:
        return
    across = float(np.median(np.abs(light[:, 0] - light[:, -1])))
    beside = float(np.median(np.abs(np.diff(light, axis=1))))
    if across > max(SEAM, TIMES * beside):
        raise InputError(
            f"projection: the picture has the shape of a panorama, but its left and right edge differ by {100 * across:.0f} %; "
            f"give {flag_of('projection')}, and {flag_of('fov_deg')} unless it is one"
        )


def _shrunk(image: "Image") -> "Image":
    """Averages over squares, few enough to go on quickly; one with a clipped pixel is clipped, and a panorama stays one."""
    import numpy as np

    pixels, saturation = image.pixels, image.saturation
    height, width = pixels.shape[:2]
    block = max(1, max(height, width) // LONGEST_SIDE)
    while (height % block or width % block) and width in (2 * height, 4 * height):
        block -= 1
    if block == 1:
        return image
    rows, columns = height // block, width // block

    def squares(values: "np.ndarray") -> "np.ndarray":
        return values[: rows * block, : columns * block].reshape(rows, block, columns, block, 3)

    mean = squares(pixels).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    noise = image.noise
    if noise is not None:
        noise = _relative(squares(np.square(noise * pixels)).sum(axis=(1, 3)) / block**4, mean)
    if saturation is not None:
        largest = squares(pixels).max(axis=(1, 3))
        clipped = (largest >= SATURATION * saturation).any(axis=-1, keepdims=True)
        mean = np.where(clipped, largest, mean)
    return image._replace(pixels=mean, noise=noise)


def _take_projection(take: Any, said: dict[str, Any], exif: "Exif", height: int, width: int) -> None:
    from diffatmo.exif import fov_deg

    by_a_camera = any(value is not None for value in (exif.make, exif.model, exif.focal_length_mm, exif.exposure_s))
    if "projection" not in said:
        if "fov_deg" in said and said["fov_deg"] < 180:
            take("projection", "pinhole")
        elif width == 2 * height and exif.focal_length_35mm_mm is None and exif.focal_length_mm is None:
            take("projection", "equirectangular", "projection: equirectangular, as it is twice as wide as high")
        elif width == 4 * height and not by_a_camera:
            take(
                "projection",
                "equirectangular",
                "projection: equirectangular to the horizon, as it is four times as wide as high",
            )
        elif by_a_camera:
            take("projection", "pinhole")
        else:
            raise InputError(
                f"projection: the file does not say how {width} x {height} pixels map to directions; give "
                f"{flag_of('projection')}, and {flag_of('fov_deg')} unless it is a panorama"
            )
    if said["projection"] != "pinhole" or "fov_deg" in said:
        return
    known = fov_deg(exif)
    if known is not None:
        take("fov_deg", known[0], f"field of view: {known[0]:.1f}° high, from Exif")
        take("focal", "free")
        return
    if exif.focal_length_mm is None:
        raise _Unknown(
            f"fov_deg: the file does not say; give {flag_of('fov_deg')}, from the top to the bottom of the picture"
        )
    phone = exif.focal_length_mm < PHONE_MM
    diagonal = PHONE_DIAGONAL_MM if phone else OTHER_DIAGONAL_MM
    # The longer side is that of a 4:3 sensor, however much was cut off above and below.
    per_pixel = 0.8 * diagonal / max(width, height)
    fov = 2 * math.degrees(math.atan(0.5 * per_pixel * height / exif.focal_length_mm))
    kind = "a phone" if phone else "a camera"
    take(
        "fov_deg",
        fov,
        f"field of view: {fov:.0f}° high ± 25 %, of {kind} with a lens of {exif.focal_length_mm:g} mm; fitted",
    )
    take("focal", "free")
    take("focal_error", FOCAL_ERROR)


def _take_sun(take: Any, said: dict[str, Any], exif: "Exif", panorama: bool) -> None:
    if {"sun", "sun_zenith_deg", "sun_azimuth_deg"} & set(said):
        return
    from_user = {"time", "latitude_deg", "longitude_deg"} & set(said)
    # A place is one thing: half of it is not completed by half of another.
    placed = bool({"latitude_deg", "longitude_deg"} & from_user)
    lacks, options = [], []
    if "time" not in said and exif.time is None:
        lacks.append("the offset of its clock from UTC" if exif.local_time else "when it was taken")
        options.append(flag_of("time"))
    if not placed and (exif.latitude_deg is None or exif.longitude_deg is None):
        lacks.append("where it was taken")
        options += [flag_of("latitude_deg"), flag_of("longitude_deg")]
    if not lacks:
        if not placed:
            take("latitude_deg", exif.latitude_deg)
            take("longitude_deg", exif.longitude_deg)
        time: Any = said.get("time", exif.time)
        where = _sun_at({**said, "time": time}, exif)
        take("time", time, f"the sun: at {time.isoformat()}, as Exif says, {where}")
    elif panorama and not from_user:
        take("sun", "detect", SUN_SEEN)
    else:
        raise _Unknown(
            f"the sun: the file does not say {' nor '.join(lacks)}; give {' and '.join(options)}, or "
            f"{flag_of('sun_zenith_deg')} and {flag_of('sun_azimuth_deg')}"
        )


def _sun_at(said: Mapping[str, Any], exif: "Exif") -> str:
    """Where the sun is then and there, in words; refuses a night that was exposed like a day."""
    from diffatmo.brackets import exposure_of

    angles = with_sun({key: said[key] for key in ("time", "latitude_deg", "longitude_deg")})
    elevation, exposure = 90 - angles["sun_zenith_deg"], exposure_of(exif)
    if elevation < -DUSK_DEG and exposure is not None and exposure < DAYLIGHT_S:
        raise InputError(
            f"time: the sun is {-elevation:.1f} degrees below the horizon then, but the exposure is one for daylight; give "
            f"{flag_of('time')} with its offset from UTC"
        )
    side = "above" if elevation >= 0 else "below"
    return f"{abs(elevation):.1f}° {side} the horizon at azimuth {angles['sun_azimuth_deg']:.0f}°"


def _take_heading(take: Any, said: dict[str, Any], exif: "Exif") -> None:
    if "yaw_deg" not in said:
        if exif.compass_deg is None:
            raise _Unknown(
                f"yaw_deg: the file has no compass; give {flag_of('yaw_deg')}, the azimuth of the optical axis"
            )
        kind = "magnetic " if exif.compass_is_magnetic else ""
        take(
            "yaw_deg",
            exif.compass_deg,
            f"azimuth: {exif.compass_deg:g}° ± {HEADING_ERROR_DEG:g}°, by the {kind}compass; fitted",
        )
        take("heading_error_deg", HEADING_ERROR_DEG)


def _take_pitch(take: Any, said: dict[str, Any], exif: "Exif", pixels: "np.ndarray") -> None:
    from diffatmo.horizon import find_horizon

    del exif
    if "pitch_deg" not in said:
        line = find_horizon(pixels)
        if line is None:
            raise _Unknown(
                f"pitch_deg: there is no straight horizon in the picture; give {flag_of('pitch_deg')}, the elevation of the "
                "optical axis"
            )
        if "fov_deg" not in said:
            return
        height = len(pixels)
        focal = 0.5 * height / math.tan(math.radians(said["fov_deg"]) / 2)
        roll = -math.degrees(math.atan(line.slope))
        below = (line.row - (height - 1) / 2) * math.cos(math.radians(roll))
        pitch = math.degrees(math.atan(below / focal))
        take("pitch_deg", pitch, f"elevation of the axis: {pitch:.1f}°, by the horizon in row {line.row:.0f}; fitted")
        take("roll_deg", roll)


def pressure(image: "Image | None") -> tuple[float, float]:
    """Of the air at the place, hPa, and the error of its logarithm."""
    if image is None or image.exif.altitude_m is None:
        return 1013.25 * math.exp(-0.3 / SCALE_HEIGHT_KM), 0.08
    return 1013.25 * math.exp(-max(image.exif.altitude_m, 0) / 1000 / SCALE_HEIGHT_KM), 0.02


def glow(pixels: "np.ndarray", camera: "Camera") -> "np.ndarray | None":
    """The middle of the brightest part of the sky, some degrees across.

    None of a sky that is as bright everywhere, or is so here and there, or all along the horizon.
    """
    import numpy as np

    directions = np.asarray(camera.directions()).reshape(-1, 3)
    # What is not known is no glow; what is infinite is as bright as anything else.
    light = np.nan_to_num(pixels.mean(axis=-1), posinf=0.0, neginf=0.0).ravel()
    light = np.where(np.isposinf(pixels).any(axis=-1).ravel(), light.max(), light)
    above = directions[:, 2] > 0
    if not above.any():
        return None
    weight = np.asarray(camera.solid_angles()).ravel()[above]
    light, directions = light[above], directions[above]
    # The brightest pixels that together are a disc of GLOW_DEG, and all that are as bright: of a plateau it is the middle.
    order = np.argsort(-light, kind="stable")
    within = order[np.cumsum(weight[order]) <= 2 * np.pi * (1 - math.cos(math.radians(GLOW_DEG)))]
    if not within.size or light[within[-1]] < BRIGHTER * np.median(light):
        return None
    chosen = light >= light[within[-1]]
    middle = (weight[chosen, None] * directions[chosen]).sum(axis=0) / weight[chosen].sum()
    length = float(np.linalg.norm(middle))
    return (middle / length).astype(np.float32) if length > TOGETHER else None


def find_mask(pixels: "np.ndarray", camera: "Camera", towards: "np.ndarray", options: Mapping[str, Any]) -> "SkyMask":
    """The clear sky in a picture."""
    import numpy as np

    from diffatmo.skymask import find_sky

    directions = np.asarray(camera.directions())
    # Of a photo the pose is rough, and the horizon in it tells more.
    elevation = np.arcsin(np.clip(directions[..., 2], -1, 1)) if options["projection"] == "equirectangular" else None
    from_sun = np.arccos(np.clip(directions @ np.asarray(towards), -1, 1))
    return find_sky(pixels, elevation=elevation, from_sun=from_sun, saturation=options.get("saturation"))


def shared_noise(observation: "Observation") -> "np.ndarray":
    """The relative noise of as many independent pixels that determine as much as those of ``observation``."""
    import numpy as np

    angles, block = np.asarray(observation.camera.solid_angles()), observation.block
    padded = np.pad(angles, [(0, -size % block) for size in angles.shape])
    blocks = padded.reshape(padded.shape[0] // block, block, padded.shape[1] // block, block).sum(axis=(1, 3))
    each = blocks[observation.used].sum() / observation.used.sum()
    return np.maximum(observation.noise, np.float32(ERROR * math.sqrt(max(PATCH_SR / each, 1.0))))
