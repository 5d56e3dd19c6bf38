"""``diffatmo import``: the atmosphere in another renderer's preset."""

from pathlib import Path

import click

from diffatmo.cli import keys
from diffatmo.cli.common import InputError, check_output, overwrite_option
from diffatmo.cli.export import PRESETS
from diffatmo.cli.keys import Numbers

CHANNEL_KEYS = {
    "wavelengths_nm": Numbers(
        "Of the channels, red first, where the preset does not say.  [default: 680,550,440]",
        expected="numbers, like 680,550,440",
    )
}


@click.command("import")
@click.argument("preset", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    metavar="ATM.toml",
    type=click.Path(path_type=Path),
    required=True,
    help="Atmosphere file to write.",
)
@click.option("--from", "target", type=click.Choice(PRESETS), help="Whose preset it is.  [default: what it looks like]")
@keys.options(CHANNEL_KEYS)
@overwrite_option
def import_preset(preset: Path, output: Path, target: str | None, wavelengths_nm: str | None, overwrite: bool) -> None:
    """Read the parameters of another renderer.

    PRESET is a file that diffatmo export --preset has written, or one of that form: a SkyAtmosphere that was copied in Unreal's
    editor, a script that sets Blender's sky texture, a call of three-geospatial's AtmosphereParameters. What it does not say
    is what the renderer does by default; the sun's irradiance is 1.
    """
    wavelengths = keys.given(CHANNEL_KEYS, {"wavelengths_nm": wavelengths_nm}).get("wavelengths_nm")
    check_output(output, overwrite=overwrite)
    try:
        text = preset.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{preset}: is no text: {error.reason}") from error
    from diffatmo import atmosphere, imageio, presets

    target = target or presets.target_of(text)
    air = presets.read(text, target, wavelengths=wavelengths, source=str(preset))
    with imageio.atomic_write(output, overwrite=overwrite) as path:
        atmosphere.save(air, path)
    bands = ", ".join(f"{band:g}" for band in air.wavelengths.tolist())
    click.echo(f"{output}: a preset of {target}, at {bands} nm")
