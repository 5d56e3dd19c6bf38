"""``diffatmo compare``: one sky by every model, side by side, and how far each is from the truth."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from diffatmo import folders
from diffatmo.cli import keys
from diffatmo.cli.common import MODELS, InputError, make_console, make_model, overwrite_option, read_atmosphere, waiting
from diffatmo.cli.keys import CAMERA_KEYS, PLACE_KEYS
from diffatmo.cli.render import DEFAULTS, SIZE, make_scene, noise_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from diffatmo.comparison import Errors, Outcome
    from diffatmo.render import Scene

SCHEMA, SCHEMA_VERSION = "diffatmo-compare", 1
CENTRED = DEFAULTS | {"sun_azimuth_deg": 180.0}
"""With the sun in the middle of a panorama."""

DEFAULT_WIDTH = 96
DEFAULT_SAMPLES = 256
FILES = ("compare.json", "compare.html", "compare.png")
PREFIXES = ("picture_", "error_")
TRUTHS = ("moments", "pathtrace")
COLUMNS = {
    "model": "model",
    "rms": "RMS, sky",
    "mean": "mean",
    "largest": "largest",
    "horizon": "RMS, lowest 5°",
    "ground": "RMS, ground",
    "noise": "noise",
    "prepare": "tables",
    "image": "image",
    "compile": "compile",
}


def _models(_: click.Context, __: click.Parameter, value: str | None) -> list[str]:
    names = list(MODELS) if value is None else [name.strip() for name in value.split(",")]
    for name in names:
        if name not in MODELS:
            raise InputError(f"--models: got {name!r}, expected names out of {', '.join(MODELS)}")
    return names


@click.command()
@click.argument("atmosphere", metavar="ATM.toml")
@click.option("-o", "--output", metavar="DIR", type=click.Path(path_type=Path), required=True, help="Folder to write.")
@click.option("--models", callback=_models, metavar="NAME,...", help=f"Which.  [default: {','.join(MODELS)}]")
@click.option(
    "--truth",
    type=click.Choice(TRUTHS),
    default=TRUTHS[0],
    show_default=True,
    help="The model that errors are relative to. The path tracer is right but noisy, moments is exact to 0.2 %.",
)
@click.option(
    "--samples",
    type=click.IntRange(min=32),
    default=DEFAULT_SAMPLES,
    show_default=True,
    help="Paths per pixel of pathtrace.",
)
@click.option("--width", type=SIZE, default=DEFAULT_WIDTH, show_default=True, help="Pixels across.")
@click.option("--height", type=SIZE, help="Pixels down.  [default: by the projection]")
@keys.options(CAMERA_KEYS, CENTRED)
@keys.options(PLACE_KEYS, CENTRED)
@overwrite_option
def compare(
    atmosphere: str,
    output: Path,
    models: list[str],
    truth: str,
    samples: int,
    width: int,
    height: int | None,
    overwrite: bool,
    **values: Any,
) -> None:
    """Render one sky with all models and hold them against each other.

    ATM.toml is an atmosphere file or the name of a preset. DIR receives every picture and its signed relative error as EXR,
    the sheet of all of them as PNG and in an HTML page, and the table as JSON. Relative errors are weighted by solid angle,
    over all wavelengths, more than 3° from the sun; times are those of this machine.
    """
    given = CENTRED | keys.with_sun(keys.given(CAMERA_KEYS | PLACE_KEYS, values))
    keys.check_camera_options(given)
    names = list(dict.fromkeys([truth, *models]))
    air = read_atmosphere(atmosphere)
    folders.prepare(output, names=FILES, prefixes=PREFIXES, overwrite=overwrite)

    from diffatmo import comparison
    from diffatmo import scene as scenes
    from diffatmo.models import PathTrace

    scene = make_scene(air, given, width, height)
    console = make_console()
    outcomes: dict[str, Outcome] = {}
    for name in names:
        with waiting(console, f"{name} …"):
            chosen = make_model(name, samples=samples if name == "pathtrace" else None)
            outcomes[name] = comparison.run(scene, chosen)
            # At once: the next model may take long, and may be interrupted.
            picture, error = outcomes[name].picture, outcomes[name].stderr
            notes = {"model": name} | ({} if error is None else noise_of(picture, error))
            scenes.save(output / f"picture_{name}.exr", picture, scene, notes=notes, overwrite=True)
    found = {name: comparison.errors(scene, outcome, outcomes[truth]) for name, outcome in outcomes.items()}
    paths = PathTrace(samples=samples).paths if "pathtrace" in names else None
    _write(output, scene, outcomes, found, truth, paths)
    console.print(_table(outcomes, found, truth))
    console.print(f"Pictures and report: {output / 'compare.html'}", soft_wrap=True)


def _cells(name: str, outcome: "Outcome", found: "Errors", truth: str) -> list[str]:
    """What the table says of one model, as text."""

    def percent(value: float, sign: str = "") -> str:
        return "–" if math.isnan(value) else f"{100 * value:{sign}.2f} %"

    def milliseconds(value: float) -> str:
        return f"{1000 * value:.0f} ms" if value < 10 else f"{value:.0f} s"

    errors = ["truth", *[""] * 4] if name == truth else [
        percent(found.rms), percent(found.mean, "+"), percent(found.largest), percent(found.horizon), percent(found.ground)
    ]  # fmt: skip
    noise = percent(found.noise) if found.noise > 0 else ""
    times = [milliseconds(outcome.prepare_s), milliseconds(outcome.image_s)]
    return [name, *errors, noise, *times, "" if name == "pathtrace" else f"{outcome.compile_s:.1f} s"]


def _table(outcomes: "dict[str, Outcome]", found: "dict[str, Errors]", truth: str) -> "Table":
    from rich.table import Table

    table = Table(title=f"relative to {truth}")
    for number, heading in enumerate(COLUMNS.values()):
        table.add_column(heading, justify="right" if number else "left")
    for name, outcome in outcomes.items():
        table.add_row(*_cells(name, outcome, found[name], truth))
    return table


def _sheet(scene: "Scene", outcomes: "dict[str, Outcome]", truth: str) -> "Figure":
    """All pictures through one exposure in the first row, the error of each at every wavelength below it."""
    import jax.numpy as jnp
    import numpy as np
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from diffatmo import color, comparison
    from fitting import figures

    wavelengths, irradiance = scene.atmosphere.wavelengths, scene.atmosphere.solar_irradiance
    developed = {
        name: color.to_linear_srgb_of_sunlight(
            jnp.asarray(outcome.picture), wavelengths=wavelengths, irradiance=irradiance
        )
        for name, outcome in outcomes.items()
    }
    exposure = color.auto_exposure(developed[truth])
    errors = {name: comparison.relative(scene, outcome, outcomes[truth]) for name, outcome in outcomes.items()}
    bands = [0, wavelengths.size // 2, wavelengths.size - 1] if wavelengths.size > 3 else list(range(wavelengths.size))
    # One scale for all: what most pixels of the worst but one model are within.
    lit = {name: e[np.isfinite(e)] for name, e in errors.items() if name != truth}
    ends = sorted(float(np.percentile(np.abs(e), 98)) for e in lit.values() if e.size)
    scale = max(ends[-2] if len(ends) > 1 else ends[-1] if ends else 0.01, 1e-4)
    rows = 1 + len(bands)
    shape = scene.camera.height / scene.camera.width
    figure = Figure(figsize=(3 * len(outcomes), 3 * shape * rows + 0.4 * rows), layout="constrained")
    axes = figure.subplots(rows, len(outcomes), squeeze=False)
    for column, (name, rgb) in enumerate(developed.items()):
        shown = color.encode(rgb, exposure=exposure)
        axes[0, column].imshow(np.asarray(shown), interpolation="nearest")
        figures.bare(axes[0, column], name)
        for row, band in enumerate(bands, start=1):
            panel = axes[row, column]
            panel.imshow(figures.diverging(errors[name][..., band], scale), interpolation="nearest")
            figures.bare(panel, f"{float(wavelengths[band]):g} nm" if name != truth else "truth")
    bar = figure.colorbar(
        ScalarMappable(Normalize(-100 * scale, 100 * scale), "RdBu_r"),
        ax=list(axes[1:].flat),
        shrink=0.6,
        pad=0.01,
        extend="both",
    )
    bar.set_label(f"relative to {truth}, %", fontsize=8)
    return figure


def _write(
    directory: Path,
    scene: "Scene",
    outcomes: "dict[str, Outcome]",
    found: "dict[str, Errors]",
    truth: str,
    paths: int | None,
) -> None:
    import html
    import json

    import numpy as np

    from diffatmo import __version__, comparison, imageio
    from diffatmo import scene as scenes
    from fitting import report

    for name, outcome in outcomes.items():
        if name != truth:
            notes = {"model": name, "relative_to": truth}
            off = comparison.relative(scene, outcome, outcomes[truth])
            scenes.save(directory / f"error_{name}.exr", off, scene, notes=notes, overwrite=True)
    sheet = _sheet(scene, outcomes, truth)
    with imageio.atomic_write(directory / "compare.png", overwrite=True) as path:
        sheet.savefig(path, format="png", dpi=110)

    def known(values: dict[str, float]) -> dict[str, float | None]:
        return {key: value if np.isfinite(value) else None for key, value in values.items()}

    record = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "diffatmo": __version__,
        "truth": truth,
        "paths": paths,
        "scene": scenes.dumps(scene),
        "models": {
            name: known(
                found[name]._asdict()
                | {"prepare_s": outcome.prepare_s, "image_s": outcome.image_s, "compile_s": outcome.compile_s}
            )
            for name, outcome in outcomes.items()
        },
    }
    rows = [list(COLUMNS.values()), *(_cells(name, outcome, found[name], truth) for name, outcome in outcomes.items())]
    cells = "".join(
        "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row) + "</tr>"
        for tag, row in zip(["th", *["td"] * len(outcomes)], rows, strict=True)
    )
    page = "\n".join(
        (
            "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
            f"<title>diffatmo compare</title><style>{report.STYLE}</style>",
            "<h1>One sky, several models</h1>",
            f"<p class=soft>Relative differences to {truth}, weighted by solid angle, over all wavelengths and more than "
            f"{comparison.SUN_DEG:g}° from the sun. Noise is the standard error that the path tracer brings along. Tables are "
            "what does not depend on where one looks. Times are those of the machine that made this page; the path tracer's "
            "have its compilation in them.</p>",
            f"<table>{cells}</table>",
            report.figure_tag(sheet, "Above: the pictures, through one exposure. Below: the error at each wavelength."),
            f"<h2>Scene</h2><pre>{html.escape(scenes.dumps(scene))}</pre></html>",
        )
    )
    for name, text in (("compare.json", json.dumps(record, indent=2, allow_nan=False)), ("compare.html", page)):
        with imageio.atomic_write(directory / name, overwrite=True) as path:
            path.write_text(text, encoding="utf-8")
