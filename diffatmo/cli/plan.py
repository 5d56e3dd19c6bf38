"""``diffatmo plan``: what each further photograph would buy.

``plan.json`` holds finite numbers or null, under the keys

====================  ================================================================================================
``schema``            ``"diffatmo-plan"``; ``schema_version`` rises when a key changes its meaning or goes
``atmosphere``        about which everything is taken to be linear, in the keys of its file
``for``               the parameters whose error bars are to shrink
``exposure``          of the shots in the sequence
``sensor``            what a frame is taken to be worth
``now``               name of each number → ``value``, ``unit``, ``standard_error`` (null: not determined)
``ranking``           of all shots, the largest gain first: ``shot``, ``sun_zenith_deg``, ``exposure``, ``gain``, ``gains`` by
                      parameter, ``standard_errors`` by number; of photographs ``fov_deg``, ``yaw_deg`` from the sun's azimuth,
                      ``pitch_deg``, ``bracketed``
``sequence``          the same, of the best shot, of the best after that one, and so on
====================  ================================================================================================
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from diffatmo import folders
from diffatmo.cli.common import InputError, make_console, overwrite_option, read_atmosphere, waiting
from diffatmo.cli.jobs import Job, prepare
from diffatmo.cli.keys import Number, read
from diffatmo.cli.running import fitting_model
from diffatmo.cli.scenefile import IMAGE_KEYS, MODELS, read_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from rich.table import Table

    from fitting.planning import Plan, Prospect

SCHEMA, SCHEMA_VERSION = "diffatmo-plan", 1
FILES = ("plan.json", "plan.png", "plan.html")
SHOWN = 12
"""Shots in the terminal and in the picture of gains by parameter."""

CAVEAT = (
    "The bounds know the noise alone: clouds, flare and the model's own errors come on top, so a promise that rests on the "
    "noise of many pixels is kept only as far as the model is right. They hold for small errors around the atmosphere planned "
    "with."
)
VAGUE_NOTE = "Gains are reckoned as if every parameter had been known to a factor of twenty beforehand."


def _suns(_: click.Context, __: click.Parameter, value: str | None) -> list[float] | None:
    if value is None:
        return None
    key, found = IMAGE_KEYS["sun_zenith_deg"], []
    for item in value.split(","):
        try:
            number: Any = float(item)
        except ValueError:
            number = item.strip()
        found.append(read(key, "--suns", number))
    return list(dict.fromkeys(found))


@click.command()
@click.argument("scene", metavar="SCENE.toml", type=click.Path(path_type=Path))
@click.option("-o", "--output", metavar="DIR", type=click.Path(path_type=Path), required=True, help="Folder to write.")
@click.option(
    "--for",
    "aims",
    metavar="NAME,...",
    help="Parameters whose error bars are to shrink: fields, derived ones, or single numbers like mie_optical_depth_550.  "
    "[default: all that are free]",
)
@click.option(
    "--atmosphere",
    metavar="ATM.toml",
    help="The best that is known, like the atmosphere.toml of a fit.  [default: init of the scene]",
)
@click.option(
    "--shots", type=click.IntRange(min=1), default=3, show_default=True, help="Length of the sequence of shots."
)
@click.option(
    "--suns", metavar="DEG,...", callback=_suns, help="Zenith angles of the sun to choose from.  [default: 20 to 95]"
)
@click.option(
    "--exposure",
    help="Of the shots: fixed, free, free-per-channel, or a group of the scene that they share.  [default: that of the last "
    "image]",
)
@click.option("--noise", type=float, help="Relative standard deviation per pixel.  [default: that of the images]")
@click.option("--altitude-km", type=float, help="Where the shots are taken.  [default: as the first image, or 0.1]")
@click.option("--model", type=click.Choice(MODELS), help="How the sky is computed.  [default: that of the scene]")
@overwrite_option
def plan(
    scene: Path,
    output: Path,
    aims: str | None,
    atmosphere: str | None,
    shots: int,
    suns: list[float] | None,
    exposure: str | None,
    noise: float | None,
    altitude_km: float | None,
    model: str | None,
    overwrite: bool,
) -> None:
    """Rank what to photograph next by how much it would shrink the error bars.

    SCENE.toml is that of a fit; without images in it, the first photograph is planned. Shots are the whole sky, photographs
    in several directions, the surroundings of the sun in a short exposure, and its disc through a neutral filter, from high
    sun to twilight. Writes plan.json, plan.png and plan.html.
    """
    job = prepare(read_scene(scene, least=0).override(model=model))
    at = job.init if atmosphere is None else read_atmosphere(atmosphere)
    options = {"noise": noise, "altitude_km": altitude_km}
    keys: dict[str, Any] = {"noise": Number("", 0, 10, positive=True), "altitude_km": IMAGE_KEYS["altitude_km"]}
    given = {
        name: read(keys[name], f"--{name.replace('_', '-')}", value)
        for name, value in options.items()
        if value is not None
    }
    names = None if aims is None else [name.strip() for name in aims.split(",") if name.strip()]
    begun = output.exists()
    folders.prepare(output, names=FILES, overwrite=overwrite)
    console = make_console()
    chosen = exposure or (job.observations[-1].exposure if job.observations else "fixed")
    with waiting(console, "compiling the model and its derivatives, then weighing the shots …"):
        try:
            found = _find(job, at, names, shots, suns, chosen, given)
        except ValueError:
            if not begun:
                output.rmdir()
            raise
    _write(output, found, chosen)
    console.print(_ranking(found, chosen))
    console.print(_sequence(found))
    console.print(f"{VAGUE_NOTE} {CAVEAT}", style="dim")
    console.print(f"Picture and table: {output / 'plan.html'}", soft_wrap=True)


def _find(
    job: Job, at: Any, aims: Sequence[str] | None, count: int, suns: Sequence[float] | None, exposure: str, given: Any
) -> "Plan":
    import numpy as np

    from fitting import planning

    own, other = np.asarray(job.init.wavelengths), np.asarray(at.wavelengths)
    if own.shape != other.shape or not np.allclose(own, other):
        raise InputError(f"--atmosphere: has wavelengths {other.tolist()}, the scene {own.tolist()} nm")
    if exposure in ("fixed-per-channel", "-per-channel"):
        raise InputError(f"--exposure: got {exposure!r}, expected fixed, free, free-per-channel or the name of a group")
    sensor = planning.Sensor.like(job.observations)
    zeniths = planning.SUNS if suns is None else [math.radians(zenith) for zenith in suns]
    return planning.plan(
        job.observations,
        atmosphere=at,
        free=job.free,
        tie=job.tie,
        priors=job.priors,
        aims=aims,
        shots=planning.candidates(zeniths, [exposure]),
        ranked_only=planning.candidates(zeniths, [_other(exposure)]),
        count=count,
        sensor=replace(sensor, noise=given.get("noise", sensor.noise)),
        altitude=given.get("altitude_km"),
        model=fitting_model(job.model, photos=job.photos),
    )


def _other(exposure: str) -> str:
    """What the exposure might be instead: known where it is not, and the reverse."""
    return "free" if exposure == "fixed" else "fixed"


def _called(exposure: str) -> str:
    """An exposure in words."""
    return {
        "fixed": "exposure known",
        "free": "exposure unknown",
        "free-per-channel": "exposure unknown in each channel",
    }.get(exposure, f"exposure of {exposure}")


# Tables -------------------------------------------------------------------------------------------------------------


def _ranked(found: "Plan", exposure: str) -> "list[tuple[Prospect, Prospect]]":
    """The shots with their exposure, the best first, and the same with the other one."""
    others = {prospect.shot.name: prospect for prospect in found.ranking if prospect.shot.exposure == _other(exposure)}
    return [(mine, others[mine.shot.name]) for mine in found.ranking if mine.shot.exposure == exposure]


def _gain(value: float) -> str:
    return f"×{value:.3g}" if value < 999.5 else f"×{value:.0f}"


def _rows(found: "Plan", exposure: str) -> list[list[str]]:
    """The ranking as text, under :func:`_headings`."""
    rows = []
    for number, (mine, other) in enumerate(_ranked(found, exposure), start=1):
        most = sorted(mine.gains.items(), key=lambda item: -item[1])[:2]
        named = ", ".join(f"{name} {_gain(gain)}" for name, gain in most if gain > 1.005)
        sun = f"{math.degrees(mine.shot.sun_zenith):g}°"
        rows.append([str(number), mine.shot.kind, sun, _gain(mine.gain), _gain(other.gain), named])
    return rows


def _headings(exposure: str) -> list[str]:
    return ["", "shot", "sun at", "gain", f"with {_called(_other(exposure))}", "gains most"]


def _ranking(found: "Plan", exposure: str) -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=_title(exposure), box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, title_justify="left")
    for heading in _headings(exposure):
        side: Any = "left" if heading in ("shot", "gains most") else "right"
        table.add_column(heading.replace(" exposure", "\nexposure"), justify=side)
    for row in _rows(found, exposure)[:SHOWN]:
        table.add_row(*row)
    return table


def _title(exposure: str) -> str:
    return f"Error bars shrink by one more photograph ({_called(exposure)})"


def _steps(found: "Plan") -> list[tuple[str, list[float | None]]]:
    """Now, and after each shot of the sequence: what to call it, and the error bars."""
    return [
        ("now", found.standard_errors),
        *((f"+ {prospect.shot.name}", prospect.standard_errors) for prospect in found.sequence),
    ]


def _error_rows(found: "Plan") -> list[list[str]]:
    """For each parameter aimed at, its error bar at each step, in % of its value where it has one."""
    from fitting.planning import relative

    rows = []
    for aim in found.aims:
        members = [number for number, q in enumerate(found.quantities) if aim in (q.name, q.field)]
        cells = []
        for _, errors in _steps(found):
            share = relative(found.quantities, found.values, errors, aim)
            known = [error for number in members if (error := errors[number]) is not None]
            if share is not None:
                cells.append(f"{100 * share:.2g} %" if share < 10 else "> 1000 %")
            elif len(known) < len(members):
                cells.append("not determined")
            else:
                cells.append(f"{max(known):.2g} {found.quantities[members[0]].unit}".strip())
        rows.append([aim, *cells])
    return rows


def _sequence(found: "Plan") -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title="Error bars after the best shot, the best after that one, …",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
        title_justify="left",
    )
    for number, (name, _) in enumerate([("", []), *_steps(found)]):
        table.add_column(name, justify="right" if number else "left")
    for row in _error_rows(found):
        table.add_row(*row)
    return table


# Files --------------------------------------------------------------------------------------------------------------


def _record(found: "Plan", exposure: str) -> dict[str, Any]:
    """The contents of ``plan.json``; see the head of this module."""
    from diffatmo import __version__
    from diffatmo import atmosphere as atmospheres
    from fitting.planning import Photo

    names = [quantity.name for quantity in found.quantities]

    def entry(prospect: "Prospect") -> dict[str, Any]:
        shot = prospect.shot
        place = {"shot": shot.kind, "sun_zenith_deg": math.degrees(shot.sun_zenith), "exposure": shot.exposure}
        if isinstance(shot, Photo):
            place |= {f"{key}_deg": math.degrees(getattr(shot, key)) for key in ("fov", "yaw", "pitch")}
            place["bracketed"] = shot.bracketed
        bars = dict(zip(names, prospect.standard_errors, strict=True))
        return place | {"gain": prospect.gain, "gains": dict(prospect.gains), "standard_errors": bars}

    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "diffatmo": __version__,
        "atmosphere": atmospheres.to_dict(found.atmosphere),
        "for": list(found.aims),
        "exposure": exposure,
        "sensor": asdict(found.sensor),
        "now": {
            quantity.name: {"value": float(value), "unit": quantity.unit, "standard_error": error}
            for quantity, value, error in zip(found.quantities, found.values, found.standard_errors, strict=True)
        },
        "ranking": [entry(prospect) for prospect in found.ranking],
        "sequence": [entry(prospect) for prospect in found.sequence],
    }


def _factor(value: float, _: object = None) -> str:
    return f"×{value:g}"


def _figure(found: "Plan", exposure: str) -> "Figure":
    """Gain against the height of the sun; error bars along the sequence; gains by parameter of the best shots."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

    ranked = [mine for mine, _ in _ranked(found, exposure)]
    figure = Figure(figsize=(15, 10.5), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1, 0.95), squeeze=False)[:, 0]
    curves, steps = above.subplots(1, 2, width_ratios=(1.25, 1))
    _draw_curves(curves, ranked, exposure)
    _draw_steps(steps, found)
    gains = below.subplots()
    bar = below.colorbar(_draw_gains(gains, ranked[:SHOWN], found.aims), ax=gains, pad=0.01, shrink=0.9)
    bar.ax.yaxis.set_major_locator(MaxNLocator(6))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    bar.ax.yaxis.set_major_formatter(FuncFormatter(_factor))
    bar.ax.tick_params(labelsize=8)
    return figure


def _draw_curves(axes: "Axes", ranked: "Sequence[Prospect]", exposure: str) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

    kinds = dict.fromkeys(prospect.shot.kind for prospect in ranked)
    for kind in kinds:
        own = sorted((math.degrees(p.shot.sun_zenith), p.gain) for p in ranked if p.shot.kind == kind)
        axes.plot(*zip(*own, strict=True), marker="o", markersize=4, label=kind)
    axes.set_yscale("log")
    # Gains span less than a decade, where a logarithmic axis of its own accord has one number.
    axes.yaxis.set_major_locator(MaxNLocator(8))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(_factor))
    axes.axvline(90, color="#888", linewidth=0.8)
    axes.text(90, 1.01, "sunset", transform=axes.get_xaxis_transform(), ha="center", fontsize=8, color="#555")
    axes.set_xlabel("zenith angle of the sun, degrees")
    axes.set_title(_title(exposure), fontsize=10, pad=16)
    axes.legend(fontsize=8, frameon=False)
    axes.grid(alpha=0.25)


def _draw_steps(axes: "Axes", found: "Plan") -> None:
    from matplotlib.ticker import FuncFormatter

    from fitting.planning import relative

    positions = list(range(len(found.sequence) + 1))
    for aim in found.aims:
        shares = [relative(found.quantities, found.values, errors, aim) for _, errors in _steps(found)]
        percent = [math.nan if share is None else 100 * share for share in shares]
        axes.plot(positions, percent, marker="o", markersize=4, label=aim)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} %"))
    labels = ["\n".join(textwrap.wrap(name, 96 // len(positions))) for name, _ in _steps(found)]
    axes.set_xticks(positions, labels, fontsize=8)
    axes.set_xlim(-0.3, len(found.sequence) + 0.3)
    axes.set_title("Error bars along the sequence (no point: not determined)", fontsize=10, pad=16)
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.grid(alpha=0.25)


def _draw_gains(axes: "Axes", best: "Sequence[Prospect]", aims: Sequence[str]) -> "AxesImage":
    import numpy as np
    from matplotlib.colors import LogNorm

    gains = np.array([[prospect.gains[aim] for aim in aims] for prospect in best])
    norm = LogNorm(1, max(float(gains.max()), 1.1))
    shown = axes.imshow(gains, norm=norm, cmap="YlGnBu", aspect="auto")
    for (row, column), value in np.ndenumerate(gains):
        colour = "white" if norm(value) > 0.6 else "black"
        axes.text(column, row, _gain(value), ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(aims)), list(aims), fontsize=8)
    axes.set_yticks(range(len(best)), [f"{p.shot.name}   {_gain(p.gain)}" for p in best], fontsize=8)
    axes.set_title("Gain of each parameter by the best shots", fontsize=10)
    return shown


def _write(directory: Path, found: "Plan", exposure: str) -> None:
    import html
    import json

    from diffatmo import atmosphere as atmospheres
    from diffatmo import imageio
    from fitting import report

    figure = _figure(found, exposure)
    with imageio.atomic_write(directory / "plan.png", overwrite=True) as path:
        figure.savefig(path, format="png", dpi=110)

    def table(rows: list[list[str]]) -> str:
        tags = ["th", *["td"] * (len(rows) - 1)]
        return "<table>" + "".join(
            "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row) + "</tr>"
            for tag, row in zip(tags, rows, strict=True)
        ) + "</table>"  # fmt: skip

    sensor = found.sensor
    page = "\n".join(
        (
            "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
            f"<title>diffatmo plan</title><style>{report.STYLE}</style>",
            "<h1>What would another photograph buy?</h1>",
            f"<p>For {html.escape(', '.join(found.aims))}; {html.escape(_called(exposure))}.</p>",
            f"<p class=soft>{html.escape(VAGUE_NOTE)} {html.escape(CAVEAT)}</p>",
            f"<p class=soft>A frame counts as {sensor.pixels:.0f} pixels with {100 * sensor.noise:.2g} % noise each, a "
            f"measurement of the sun's disc as good to {100 * sensor.disc_noise:g} %. A single exposure is saturated above "
            f"{sensor.brightest:g} times its median, and read noise takes over below {sensor.darkest:g} times.</p>",
            report.figure_tag(figure, "Left: gain against the height of the sun. Right: error bars along the sequence. Below: "
                              "gain of each parameter."),
            "<h2>The sequence</h2>",
            table([["", *(name for name, _ in _steps(found))], *_error_rows(found)]),
            "<h2>All shots</h2>",
            table([_headings(exposure), *_rows(found, exposure)]),
            f"<h2>Atmosphere</h2><pre>{html.escape(atmospheres.dumps(found.atmosphere))}</pre></html>",
        )
    )  # fmt: skip
    record = json.dumps(_record(found, exposure), indent=1, allow_nan=False) + "\n"
    for name, text in (("plan.json", record), ("plan.html", page)):
        with imageio.atomic_write(directory / name, overwrite=True) as path:
            path.write_text(text, encoding="utf-8")
