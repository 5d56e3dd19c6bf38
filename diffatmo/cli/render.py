"""``diffatmo render``: a picture of an atmosphere's sky."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from diffatmo.cli import colours as camera_colours
from diffatmo.cli import keys
from diffatmo.cli.common import (
    InputError,
    check_output,
    make_model,
    model_options,
    overwrite_option,
    read_atmosphere,
)
from diffatmo.cli.keys import CAMERA_KEYS, PLACE_KEYS, Number

if TYPE_CHECKING:
    import numpy as np

    from diffatmo.atmosphere import Atmosphere
    from diffatmo.render import Scene

EXPOSURE = {"exposure": Number("Pixels are radiance times this.  [default: 1; for PNG, by the picture]", 1e-30, 1e30)}
DEFAULTS = {"projection": "equirectangular", "altitude_km": 0.1, "sun_zenith_deg": 45.0, "sun_azimuth_deg": 0.0}
DEFAULT_WIDTH = 512
SIZE = click.IntRange(1, 16384)


@click.command()
@click.argument("atmosphere", metavar="ATM.toml")
@click.option(
    "-o",
    "--output",
    "outputs",
    metavar="IMAGE",
    type=click.Path(path_type=Path),
    multiple=True,
    required=True,
    help="File to write, .exr or .png; may be given more than once.",
)
@model_options
@click.option("--width", type=SIZE, help="Pixels across.  [default: 512]")
@click.option("--height", type=SIZE, help="Pixels down.  [default: by the projection]")
@keys.options(CAMERA_KEYS, DEFAULTS)
@keys.options(PLACE_KEYS, DEFAULTS)
@keys.options(EXPOSURE)
@click.option("--sun-disc", is_flag=True, help="Draw the disc of the sun.")
@click.option(
    "--colours",
    metavar="FIT.json",
    type=click.Path(path_type=Path),
    help="In the exposure and colours of the photo that was fitted there; ATM.toml is that fit's atmosphere.toml.",
)
@overwrite_option
def render(
    atmosphere: str,
    outputs: tuple[Path, ...],
    model: str,
    samples: int | None,
    seed: int | None,
    width: int | None,
    height: int | None,
    sun_disc: bool,
    colours: Path | None,
    overwrite: bool,
    **values: Any,
) -> None:
    """Render a picture of the sky.

    ATM.toml is an atmosphere file or the name of a preset. An EXR holds linear radiance at every wavelength and, in its
    header, everything that it was made from; a PNG is developed for the screen. With --colours both have the photo's three
    channels, and an EXR no header.
    """
    given = keys.given(CAMERA_KEYS | PLACE_KEYS | EXPOSURE, values)
    options: dict[str, Any] = DEFAULTS | keys.with_sun(given)
    keys.check_camera_options(options)
    writers = [(path, _writer(path)) for path in outputs]
    for path in outputs:
        check_output(path, overwrite=overwrite)
    import numpy as np

    from diffatmo import render
    from diffatmo.compiling import outermost
    from diffatmo.models import PathTrace

    chosen = make_model(model, samples=samples, seed=seed)
    air = read_atmosphere(atmosphere)
    seen = None if colours is None else camera_colours.read(colours, air)
    scene = make_scene(air, options, width, height)
    notes: dict[str, Any] = {"model": model, "sun_disc": sun_disc}
    if isinstance(chosen, PathTrace):
        pixels, error = map(np.asarray, outermost(render.render_with_error)(scene, chosen, sun_disc=sun_disc))
        notes |= {"samples": chosen.samples, "seed": chosen.seed} | noise_of(pixels, error)
    else:
        pixels = np.asarray(outermost(render.render)(scene, chosen, sun_disc=sun_disc))
    if seen is not None:
        for path in outputs:
            _write_seen(path, seen.develop(pixels), encoded=seen.encoded, automatic="exposure" not in given)
        return
    for path, write in writers:
        write(path, pixels, scene, notes, "exposure" not in given)


def noise_of(pixels: "np.ndarray", error: "np.ndarray") -> dict[str, float]:
    """What a fit of a picture by the path tracer is to know: the RMS relative standard error, where there is light."""
    lit = pixels > 0
    return {"noise": float(((error[lit] / pixels[lit]) ** 2).mean() ** 0.5)} if lit.any() else {}


def make_scene(air: "Atmosphere", options: Mapping[str, Any], width: int | None, height: int | None) -> "Scene":
    """What ``options``, with the keys of ``DEFAULTS`` at least, say is to be seen."""
    from diffatmo import render, sun

    width, height = picture_size(options, width, height)
    camera = keys.make_camera({k: v for k, v in options.items() if k in CAMERA_KEYS}, height=height, width=width)
    towards = sun.direction(
        zenith=math.radians(options["sun_zenith_deg"]), azimuth=math.radians(options["sun_azimuth_deg"])
    )
    return render.Scene(air, camera, options["altitude_km"], towards, options.get("exposure", 1.0))


def picture_size(options: Mapping[str, Any], width: int | None, height: int | None) -> tuple[int, int]:
    """(width, height), with square pixels where one of them is not said."""
    projection = options["projection"]
    ratio = {"equirectangular": 4 if options.get("upper") else 2, "fisheye": 1, "pinhole": 1.5}[projection]
    if width is None:
        width = round(height * ratio) if height is not None else DEFAULT_WIDTH
    return width, height if height is not None else max(1, round(width / ratio))


def _writer(path: Path) -> Callable[..., None]:
    writers = {".exr": _write_exr, ".png": _write_png}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path}: expected a name that ends in .exr or .png")
    return writers[path.suffix.lower()]


def _write_seen(path: Path, rgb: "np.ndarray", *, encoded: bool, automatic: bool) -> None:
    """A picture in a photo's own channels, which are about those of sRGB."""
    import jax.numpy as jnp
    import numpy as np

    from diffatmo import color, imageio

    if path.suffix.lower() == ".exr":
        imageio.write_exr(path, rgb, overwrite=True)
    elif encoded:
        imageio.write_png(path, np.asarray(color.srgb_encode(jnp.clip(jnp.asarray(rgb), 0, 1))), overwrite=True)
    else:
        exposure = color.auto_exposure(jnp.asarray(rgb)) if automatic else 1.0
        imageio.write_png(path, np.asarray(color.encode(jnp.asarray(rgb), exposure=exposure)), overwrite=True)


def _write_exr(path: Path, pixels: "np.ndarray", scene: "Scene", notes: dict[str, Any], automatic: bool) -> None:
    from diffatmo import scene as scenes

    del automatic  # An EXR is for numbers: its exposure is what was asked for.
    scenes.save(path, pixels, scene, notes=notes, overwrite=True)


def _write_png(path: Path, pixels: "np.ndarray", scene: "Scene", notes: dict[str, Any], automatic: bool) -> None:
    import jax.numpy as jnp
    import numpy as np

    from diffatmo import color, imageio

    del notes
    air = scene.atmosphere
    rgb = color.to_linear_srgb_of_sunlight(
        jnp.asarray(pixels), wavelengths=air.wavelengths, irradiance=air.solar_irradiance
    )
    codes = color.encode(rgb, exposure=color.auto_exposure(rgb) if automatic else 1.0)
    imageio.write_png(path, np.asarray(codes), overwrite=True)
