"""``diffatmo export``: an atmosphere for a renderer, as the tables of Bruneton or Hillaire, or as its own parameters."""

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from diffatmo import folders
from diffatmo.cli import keys
from diffatmo.cli.common import InputError, check_output, make_console, overwrite_option, read_atmosphere, waiting
from diffatmo.cli.keys import CAMERA_KEYS, PLACE_KEYS, Number
from diffatmo.cli.render import DEFAULTS, SIZE, make_scene

if TYPE_CHECKING:
    from diffatmo.atmosphere import Atmosphere
    from diffatmo.export import Texture

LUTS = ("bruneton", "hillaire")
PARAMETERISATIONS = ("2017", "2008")
"""Those of ``diffatmo.models.tables``, repeated here because importing that takes seconds; a test compares the two."""

PRESETS = ("unreal", "blender", "blender-nishita", "three-geospatial", "bruneton")
"""Those of ``diffatmo.presets``; likewise."""

FOLDERS = ("float", "half", "README.md")
VOLUME_KEYS = {"reach_km": Number("How far the aerial perspective reaches.", 0, positive=True)}
VIEWED = DEFAULTS | {"projection": "pinhole", "reach_km": 32.0}
DEFAULT_WIDTH = 960
DEFAULT_ORDERS = 4
PHASES = {
    "henyey-greenstein": "1 / (4 π) (1 - g²) / (1 + g² - 2 g nu)^(3/2)",
    "cornette-shanks": "3 / (8 π) (1 - g²) (1 + nu²) / ((2 + g²) (1 + g² - 2 g nu)^(3/2))",
}
TABLE = "the table of the atmosphere file, linear in nu between its angles, divided by its integral over all directions"


@click.command()
@click.argument("atmosphere", metavar="ATM.toml")
@click.option("--luts", type=click.Choice(LUTS), help="Whose tables.")
@click.option("--preset", type=click.Choice(PRESETS), help="Whose parameters.")
@click.option(
    "-o",
    "--output",
    metavar="PATH",
    type=click.Path(path_type=Path),
    required=True,
    help="Folder to write the tables to, or file for the parameters.",
)
@click.option(
    "--parameterisation",
    type=click.Choice(PARAMETERISATIONS),
    help="bruneton: where the entries of its tables are.  [default: 2017]",
)
@click.option("--orders", type=click.IntRange(min=1), help="bruneton: orders of scattering.  [default: 4]")
@click.option("--width", type=SIZE, help="hillaire: pixels across of the camera's picture.  [default: 960]")
@click.option("--height", type=SIZE, help="hillaire: pixels down.  [default: by the projection]")
@keys.options(VOLUME_KEYS, VIEWED)
@keys.options(CAMERA_KEYS, VIEWED)
@keys.options(PLACE_KEYS, VIEWED)
@overwrite_option
def export(
    atmosphere: str,
    luts: str | None,
    preset: str | None,
    output: Path,
    parameterisation: str | None,
    orders: int | None,
    width: int | None,
    height: int | None,
    overwrite: bool,
    **values: Any,
) -> None:
    """Write an atmosphere for a renderer.

    ATM.toml is an atmosphere file, earth, or mars. With --luts, PATH is a folder: it receives every table of a model
    as EXR, in single and in half precision, each with its parameterisation, its unit and what it omits in the header, and a
    README that says how to sample them. The sun, the camera and the altitude matter to hillaire only, whose last three tables
    belong to one place.

    With --preset, PATH is a file in the renderer's own terms: text to paste into Unreal's editor, a Python script for Blender,
    a JavaScript module for three-geospatial, a C++ header for Bruneton's demo. What the renderer cannot hold, and what that
    does to the sky, is printed, and said in the file. diffatmo import reads such a file.
    """
    of_place = keys.given(VOLUME_KEYS | CAMERA_KEYS | PLACE_KEYS, values)
    of_camera = of_place | {k: v for k, v in {"width": width, "height": height}.items() if v is not None}
    of_tables = {k: v for k, v in {"parameterisation": parameterisation, "orders": orders}.items() if v is not None}
    if luts is not None and preset is not None:
        raise InputError("--preset contradicts --luts: give one or the other")
    if preset is not None:
        for name in of_camera | of_tables:
            raise InputError(f"{keys.flag_of(name)} contradicts --preset: it belongs to --luts")
        _export_preset(atmosphere, preset, output, overwrite=overwrite)
        return
    if luts is None:
        raise InputError("--luts or --preset: missing, expected one of them")
    for name in of_camera if luts == "bruneton" else of_tables:
        raise InputError(f"{keys.flag_of(name)} contradicts --luts {luts}: it belongs to the other one")
    options = VIEWED | keys.with_sun(of_place)
    keys.check_camera_options(options)
    air = read_atmosphere(atmosphere)
    folders.prepare(output, names=FOLDERS, overwrite=overwrite)
    from rich.table import Table

    from diffatmo import export as tables
    from diffatmo import imageio

    console = make_console()
    with waiting(console, "computing the tables …"):
        if luts == "bruneton":
            textures, kind, facts = _bruneton(air, parameterisation or PARAMETERISATIONS[0], orders or DEFAULT_ORDERS)
        else:
            textures, kind, facts = _hillaire(air, options, width or DEFAULT_WIDTH, height)
        written = tables.write(textures, output, air, kind, overwrite=True)
    shown = Table("table", "size", "largest entry", "error of half")
    for texture in textures:
        error = tables.half_error(texture.texels)
        told = (
            f"{100 * error:.2g} %"
            if error <= tables.HALF_LOST
            else "not written: beyond its range; scale solar_irradiance"
        )
        shown.add_row(texture.name, _size(texture), f"{texture.texels.max():.4g}", told)
    with imageio.atomic_write(output / "README.md", overwrite=True) as path:
        path.write_text(_readme(luts, textures, facts), encoding="utf-8")
    console.print(shown)
    console.print(f"{len(written)} pictures; how to sample them: {output / 'README.md'}", soft_wrap=True)


def _export_preset(atmosphere: str, preset: str, output: Path, *, overwrite: bool) -> None:
    check_output(output, overwrite=overwrite)
    air = read_atmosphere(atmosphere)
    from rich.table import Table

    from diffatmo import imageio, presets

    console = make_console()
    lost = presets.losses(air, preset)
    with waiting(console, "comparing the skies …"):
        skies = presets.sky_losses(air, preset)
    text = presets.write(air, preset, remarks=presets.remarks(preset, lost, skies))
    with imageio.atomic_write(output, overwrite=overwrite) as path:
        path.write_text(text, encoding="utf-8")
    table = Table("parameter", "atmosphere", "held", "why")
    for loss in lost:
        table.add_row(loss.key, loss.before, loss.after, loss.why)
    if lost:
        console.print(table)
    for line in presets.summary(preset, lost, skies):
        console.print(line, soft_wrap=True)
    console.print(f"{output}: {presets.TARGETS[preset].use}", soft_wrap=True)


def _bruneton(air: "Atmosphere", parameterisation: str, orders: int) -> "tuple[list[Texture], str, dict[str, Any]]":
    from diffatmo import export as tables
    from diffatmo.models import Bruneton

    model = Bruneton(parameterisation=parameterisation, orders=orders)
    sizes = model.sizes
    facts = {
        "maps": _text(f"maps_{parameterisation}"),
        "parameterisation": parameterisation,
        "bottom": f"{float(air.bottom_radius):g}",
        "top": f"{float(air.top_radius):g}",
        "phase": f"{PHASES[air.mie_phase]}, g = {float(air.mie_g):g}" if isinstance(air.mie_phase, str) else TABLE,
        "mu_s_min": f"{model.mu_s_min:g}",
        "t_mu": sizes.transmittance_mu,
        "t_r": sizes.transmittance_r,
        "e_mu_s": sizes.irradiance_mu_s,
        "e_r": sizes.irradiance_r,
        "r": sizes.r,
        "mu": sizes.mu,
        "mu_s": sizes.mu_s,
        "nu": sizes.nu,
    }
    return tables.bruneton(air, model), f"Bruneton & Neyret 2008, maps of {parameterisation}", facts


def _hillaire(
    air: "Atmosphere", options: dict[str, Any], width: int, height: int | None
) -> "tuple[list[Texture], str, dict[str, Any]]":
    from diffatmo import camera as cameras
    from diffatmo import export as tables
    from diffatmo.models import Hillaire

    model = Hillaire()
    scene = make_scene(air, options, width, height)
    camera, reach = scene.camera, float(options["reach_km"])
    textures = tables.hillaire(
        air, model, altitude=options["altitude_km"], sun=scene.sun, camera=camera, reach=reach
    )  # fmt: skip
    facts = {
        "bottom": f"{float(air.bottom_radius):g}",
        "top": f"{float(air.top_radius):g}",
        "altitude": f"{options['altitude_km']:g}",
        "sun_zenith": f"{options['sun_zenith_deg']:g}",
        "sun_azimuth": f"{options['sun_azimuth_deg']:g}",
        "camera": ", ".join(f"{key} {value}" for key, value in cameras.to_dict(camera).items()),
        "t_mu": model.transmittance_size[0],
        "t_r": model.transmittance_size[1],
        "m_mu_s": model.multiple_size[0],
        "m_h": model.multiple_size[1],
        "s_u": model.sky_view_size[0],
        "s_v": model.sky_view_size[1],
        "s_half": model.sky_view_size[1] // 2,
        **dict(zip(("slices", "a_y", "a_x"), textures[-1].texels.shape[:3], strict=True)),
        "reach": f"{reach:g}",
    }
    return textures, "Hillaire 2020; transmittance as Bruneton 2017", facts


def _size(texture: "Texture") -> str:
    depth, height, width, _ = texture.texels.shape
    return f"{width}×{height}" + (f"×{depth}" if depth > 1 else "")


def _text(name: str) -> str:
    return files("diffatmo").joinpath("data", "export", f"{name}.md").read_text(encoding="utf-8").rstrip("\n")


def _readme(luts: str, textures: "list[Texture]", facts: dict[str, Any]) -> str:
    text = _text(luts)
    rows = (f"| `{t.name}` | {_size(t)} | {t.axes} | {t.unit} | {t.omits} |" for t in textures)
    # The maps first: they have names of their own.
    for name, value in {"tables": "\n".join(rows), **facts}.items():
        text = text.replace(f"@{name}@", str(value))
    return text + "\n"
