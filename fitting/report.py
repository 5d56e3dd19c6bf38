"""What a fit leaves behind: a machine-readable record, the atmosphere, pictures, and one page to look at.

:func:`write` puts into a directory

- ``fit.json``, described below,
- ``atmosphere.toml``, the fitted atmosphere as every other command reads it,
- ``fitted_<image>.exr`` and ``.png``, what the images should look like, and ``residual_<image>.exr`` and ``.png``,
  measured / fitted - 1,
- ``report.html``, self-contained.

``fit.json`` holds finite numbers or null, under the keys

====================  ================================================================================================
``schema``            ``"diffatmo-fit"``; ``schema_version`` rises when a key changes its meaning or goes
``version``           of diffatmo
``converged``         and ``message``, why the fit stopped
``iterations``        points at which χ² was evaluated; ``history`` has a row for each
``chi2``              and ``degrees_of_freedom``, ``reduced_chi2``
``error_scale``       factor √(reduced χ²) >= 1 that the standard errors contain
``wavelengths_nm``    the order of all lists of one number per wavelength
``parameters``        name of the field → ``unit``, ``value``, ``standard_error`` (null: not determined by the images),
                      ``initial``, ``truth`` (null: unknown), ``pull`` = (value - truth) / standard_error, ``at_bound``;
                      each a number, or a list for a spectral field
``derived``           the same for optical depths and single scattering albedo
``exposures``         the same for the free exposure factors
``undetermined``      names of the numbers that the images do not determine
``covariance``        ``names`` and ``matrix`` (of all numbers above), ``correlation`` likewise
``images``            for each: place, sun, exposure, masked pixels by reason, and ``residuals``: per wavelength the
                      median and the root mean square of measured / fitted - 1, and the root mean square in sigmas
``timings``           seconds: ``compile_s``, ``solve_s``, ``total_s``
====================  ================================================================================================
"""

import base64
import html
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from diffatmo import atmosphere, color, folders, imageio, scene, sun
from diffatmo.atmosphere import Atmosphere
from diffatmo.render import Scene
from fitting._errors import FitError
from fitting.observation import PER_CHANNEL, Observation, exposure_name
from fitting.uncertainty import Estimate, FitResult

SCHEMA, SCHEMA_VERSION = "diffatmo-fit", 1

FIXED_NAMES = ("fit.json", "atmosphere.toml", "report.html")
IMAGE_PREFIXES = ("fitted_", "residual_")

FAR = 3.0
"""Standard errors from the truth beyond which an estimate is marked."""

Image = Float[np.ndarray, "height width w"]


def check_writable(directory: str | Path, *, overwrite: bool = False) -> Path:
    """Create ``directory`` if need be and make sure that a report can be written there; call it before the fit.

    Raises :class:`FitError` if nothing can be created in the directory, or it holds a report and ``overwrite`` is False.
    """
    path = Path(directory)
    try:
        folders.prepare(path, names=FIXED_NAMES, prefixes=IMAGE_PREFIXES, overwrite=overwrite)
    except folders.FolderError as error:
        raise FitError(str(error)) from error
    return path


def write(
    result: FitResult, directory: str | Path, *, truth: Atmosphere | None = None, overwrite: bool = False
) -> list[Path]:
    """Write all files of the report and return their paths.

    Every file appears whole or not at all. If one cannot be written the others still are, and then ``OSError`` names
    those that are missing.
    """
    path = check_writable(directory, overwrite=overwrite)
    if truth is not None:
        result = result.with_truth(truth)
    wavelengths = [float(nm) for nm in result.atmosphere.wavelengths]
    scale = residual_scale(result.residuals)

    def text(content: Callable[[], str]) -> Callable[[Path], None]:
        def task(file: Path) -> None:
            with imageio.atomic_write(file, overwrite=overwrite) as temporary:
                temporary.write_text(content(), encoding="utf-8")

        return task

    def png(picture: Float[np.ndarray, "height width 3"]) -> Callable[[Path], None]:
        return lambda file: imageio.write_png(file, picture, overwrite=overwrite)

    def exr(pixels: Image, shot: Scene | None) -> Callable[[Path], None]:
        if shot is not None:
            return lambda file: scene.save(file, pixels, shot, overwrite=overwrite)
        return lambda file: imageio.write_exr(file, pixels, wavelengths=wavelengths, overwrite=overwrite)

    tasks = {
        "fit.json": text(lambda: json.dumps(record(result), indent=1, allow_nan=False) + "\n"),
        "atmosphere.toml": text(lambda: atmosphere.dumps(result.atmosphere)),
    }
    for name, observation, fitted, residual in zip(
        file_names(result.observations), result.observations, result.fitted, result.residuals, strict=True
    ):
        tasks[f"fitted_{name}.exr"] = exr(fitted, scene_of(result, observation))
        tasks[f"fitted_{name}.png"] = png(developed(observation, fitted, wavelengths)[1])
        tasks[f"residual_{name}.exr"] = exr(residual, None)
        tasks[f"residual_{name}.png"] = png(diverging(np.mean(residual, axis=-1), scale))
    tasks["report.html"] = text(lambda: page(result))
    failures = []
    for file, task in tasks.items():
        try:
            task(path / file)
        except (OSError, ValueError) as error:
            failures.append(str(error))
    if failures:
        raise OSError("; ".join(failures))
    return [path / file for file in tasks]


def scene_of(result: FitResult, observation: Observation) -> Scene | None:
    """The scene of a fitted image; None if its pixels are not the camera's, or have an exposure for each channel."""
    if observation.block > 1 or observation.exposure.endswith(PER_CHANNEL):
        return None
    name = exposure_name(observation)
    factor = 1.0 if name is None else result.estimate(name).value
    return Scene(
        atmosphere=result.atmosphere,
        camera=observation.camera,
        altitude=jnp.asarray(observation.altitude),
        sun=jnp.asarray(observation.sun),
        exposure=jnp.asarray(observation.exposure_value * factor),
    )


def file_names(observations: Sequence[Observation]) -> list[str]:
    """The observations' names as parts of file names, all different."""
    names: list[str] = []
    for observation in observations:
        name = re.sub(r"[^\w.-]+", "_", observation.name).strip("._") or "image"
        stem, number = name, 2
        while name in names:
            name, number = f"{stem}_{number}", number + 1
        names.append(name)
    return names


# The record ---------------------------------------------------------------------------------------------------------


def _finite(value: Any) -> Any:
    """``value`` as JSON can hold it: plain numbers, null for what is not finite."""
    if isinstance(value, np.ndarray):
        return _finite(value.tolist())
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _by_field(estimates: Sequence[Estimate]) -> dict[str, dict[str, Any]]:
    """Numbers of the same field together; lists where the field is spectral."""
    fields: dict[str, list[Estimate]] = {}
    for estimate in estimates:
        fields.setdefault(estimate.field, []).append(estimate)
    keys = ("value", "standard_error", "initial", "truth", "pull", "at_bound")
    result: dict[str, dict[str, Any]] = {}
    for field, members in fields.items():
        columns = {key: [getattr(member, key) for member in members] for key in keys}
        spectral = members[0].wavelength is not None
        result[field] = {"unit": members[0].unit} | {k: v if spectral else v[0] for k, v in columns.items()}
    return result


def record(result: FitResult) -> dict[str, Any]:
    """The contents of ``fit.json``; see the head of this module."""
    return _finite(
        {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "version": _version(),
            "converged": result.converged,
            "message": result.message,
            "iterations": result.iterations,
            "chi2": result.chi2,
            "degrees_of_freedom": result.degrees_of_freedom,
            "reduced_chi2": result.reduced_chi2,
            "error_scale": result.error_scale,
            "wavelengths_nm": [float(nm) for nm in result.atmosphere.wavelengths],
            "parameters": _by_field([e for e in result.parameters if not e.derived]),
            "derived": _by_field([e for e in result.parameters if e.derived]),
            "exposures": _by_field(result.exposures),
            "undetermined": result.undetermined,
            "covariance": {"names": result.covariance_names, "matrix": result.covariance},
            "correlation": {"names": result.covariance_names, "matrix": result.correlation},
            "images": [_image_record(result, number) for number in range(len(result.observations))],
            "history": [step._asdict() for step in result.history],
            "timings": result.timings,
        }
    )


def _version() -> str | None:
    try:
        return version("diffatmo")
    except PackageNotFoundError:
        return None


def _sun_degrees(observation: Observation) -> tuple[float, float]:
    """Zenith angle and azimuth (clockwise from north) of the sun."""
    zenith, azimuth = sun.angles(jnp.asarray(observation.sun))
    return math.degrees(zenith), math.degrees(azimuth)


def _image_record(result: FitResult, number: int) -> dict[str, Any]:
    observation = result.observations[number]
    zenith, azimuth = _sun_degrees(observation)
    relative = result.residuals[number][observation.used].astype(float)
    whitened = result.whitened[number][observation.used].astype(float)
    return {
        "name": observation.name,
        "altitude_km": observation.altitude,
        "sun_zenith_deg": zenith,
        "sun_azimuth_deg": azimuth,
        "exposure": observation.exposure,
        "exposure_value": observation.exposure_value,
        "pixels_used": len(relative),
        "pixels_masked": observation.masked,
        "binning": observation.block,
        "residuals": {
            "median_relative": np.median(relative, axis=0),
            "median_absolute_relative": np.median(np.abs(relative), axis=0),
            "rms_relative": np.sqrt(np.mean(relative**2, axis=0)),
            "rms_sigma": np.sqrt(np.mean(whitened**2, axis=0)),
        },
    }


# The table ----------------------------------------------------------------------------------------------------------


def format_number(value: float | None, error: float | None = None) -> str:
    """``value`` with the digits that its ``error`` leaves meaningful (two of the error's own), or five digits."""
    if value is None or not math.isfinite(value):
        return "–"
    if not error or not math.isfinite(error) or not value:
        return f"{value:.5g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(error)) + 2
    return f"{value:#.{max(2, min(digits, 8))}g}".rstrip(".")


class _Row(NamedTuple):
    """An estimate as text."""

    parameter: str
    unit: str
    nm: str
    fitted: str
    error: str
    relative: str
    start: str
    truth: str
    pull: str


_HEADINGS = _Row("parameter", "unit", "nm", "fitted", "± error", "relative", "start", "truth", "pull")


def _row(estimate: Estimate, *, first: bool) -> _Row:
    """The name is given in the first row of a field only."""
    error, value = estimate.standard_error, estimate.value
    if estimate.at_bound:
        shown = "at its bound"
    elif error is None:
        shown = "not determined"
    else:
        shown = f"{error:.2g}"
    return _Row(
        parameter=estimate.field if first else "",
        unit=estimate.unit if first else "",
        nm="" if estimate.wavelength is None else f"{estimate.wavelength:g}",
        fitted=format_number(value, error),
        error=shown,
        relative=f"{100 * error / abs(value):.2g} %" if error is not None and value else "",
        start="" if estimate.initial is None else f"{estimate.initial:.3g}",
        truth="" if estimate.truth is None else f"{estimate.truth:.5g}",
        pull="" if estimate.pull is None else f"{estimate.pull:+.1f}",
    )


def _rows(result: FitResult) -> list[tuple[_Row, Estimate, bool]]:
    """All rows of the table, with what they show, and whether a rule goes above (a new kind of number begins)."""
    groups = [[e for e in result.parameters if e.derived == derived] for derived in (False, True)] + [result.exposures]
    rows = []
    for number, group in enumerate(groups):
        before = None
        for estimate in group:
            rule = before is None and number > 0
            rows.append((_row(estimate, first=estimate.field != before), estimate, rule))
            before = estimate.field
    return rows


def _columns(result: FitResult, without: Sequence[str] = ()) -> list[str]:
    known = any(e.truth is not None for e in result.parameters)
    return [name for name in _Row._fields if name not in without and (known or name not in ("truth", "pull"))]


def table(result: FitResult, truth: Atmosphere | None = None) -> Table:
    """Fitted values, error bars and, where it is known, the truth, for a terminal of 80 columns."""
    if truth is not None:
        result = result.with_truth(truth)
    columns = _columns(result, without=("unit", "relative"))
    rich = Table(title=_verdict(result), title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    rich.caption, rich.caption_justify = "Lengths in km, coefficients in 1/km.", "left"
    for name in columns:
        rich.add_column(getattr(_HEADINGS, name), justify="left" if name == "parameter" else "right")
    for row, estimate, rule in _rows(result):
        if rule:
            rich.add_section()
        far = estimate.pull is not None and abs(estimate.pull) > FAR
        rich.add_row(*(Text(getattr(row, name), style="red" if far and name == "pull" else "") for name in columns))
    return rich


def _verdict(result: FitResult) -> str:
    state = "Converged" if result.converged else "Not converged"
    return f"{state} after {result.iterations} iterations, reduced χ² = {result.reduced_chi2:.3f}"


# The pictures -------------------------------------------------------------------------------------------------------

_MASKED = (0.82, 0.83, 0.85)
"""Grey of the pixels that were not used."""


def developed(
    observation: Observation, fitted: Image, wavelengths: Sequence[float]
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 3"]]:
    """The measured and the fitted image for a screen, through the same exposure and tone curve."""
    bands = jnp.asarray(wavelengths)
    # In the shape of the image, whatever pixels are used, so that images of one size share one compiled program.
    used = jnp.asarray(np.where(observation.used[..., None], observation.image, np.nan))
    exposure = color.auto_exposure(color.to_linear_srgb(used, wavelengths=bands))

    def develop(image: Image) -> Float[np.ndarray, "height width 3"]:
        known = observation.shown[..., None] & np.isfinite(image).all(axis=-1, keepdims=True)
        rgb = color.display(jnp.asarray(np.where(known, image, 0)), wavelengths=bands, exposure=exposure)
        return np.where(known, rgb, _MASKED)

    return develop(observation.image), develop(fitted)


def residual_scale(residuals: Sequence[Image]) -> float:
    """The common end of the symmetric colour scale of all residuals: 99 % of the pixels are within it."""
    values = np.concatenate([np.abs(image[np.isfinite(image)]) for image in residuals])
    return max(float(np.percentile(values, 99)), 1e-6) if values.size else 1.0


def diverging(values: Float[np.ndarray, "height width"], scale: float) -> Float[np.ndarray, "height width 3"]:
    """Blue to red over ±``scale``, white at 0, grey where there is no number."""
    colours = matplotlib.colormaps["RdBu_r"](Normalize(-scale, scale)(np.nan_to_num(values)))
    return np.where(np.isfinite(values)[..., None], colours[..., :3], _MASKED)


def _embed(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def bare(axes: Axes, title: str) -> None:
    """A panel for a picture: a title, no ticks."""
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])


def image_figure(
    observation: Observation, fitted: Image, residual: Image, wavelengths: Sequence[float], scale: float
) -> Figure:
    """Measured and fitted side by side, and below them the relative residual of each wavelength (if up to three)."""
    channels = {f"residual at {nm:g} nm": residual[..., i] for i, nm in enumerate(wavelengths)}
    if len(channels) > 3:
        channels = {"residual, mean of all wavelengths": np.mean(residual, axis=-1)}
    height, width = observation.used.shape
    rows = [height / width / 2, height / width / max(len(channels), 2)]
    figure = Figure(figsize=(10, 10 * sum(rows) + 1.1), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=rows, squeeze=False)[:, 0]
    pictures = developed(observation, fitted, wavelengths)
    for axes, picture, title in zip(above.subplots(1, 2), pictures, ("measured", "fitted"), strict=True):
        axes.imshow(picture, interpolation="nearest")
        bare(axes, title)
    panels = np.atleast_1d(below.subplots(1, len(channels)))
    norm = Normalize(-100 * scale, 100 * scale)
    for axes, (title, values) in zip(panels, channels.items(), strict=True):
        axes.imshow(diverging(values, scale), interpolation="nearest")
        bare(axes, title)
    bar = below.colorbar(ScalarMappable(norm, "RdBu_r"), ax=list(panels), shrink=0.8, pad=0.01)
    bar.set_label("residual, %", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


def convergence_figure(result: FitResult) -> Figure:
    """Reduced χ² and the distance to the optimum against the step; rejected steps are hollow."""
    figure = Figure(figsize=(6.2, 3.4), layout="constrained")
    axes = figure.subplots()
    steps = np.array([step.step for step in result.history])
    chi2 = np.array([step.reduced_chi2 for step in result.history])
    accepted = np.array([step.accepted for step in result.history]) & np.isfinite(chi2)
    rejected = ~accepted & np.isfinite(chi2)
    axes.semilogy(steps[accepted], chi2[accepted], "o-", color="#1f5fa8", label="reduced χ²")
    if rejected.any():
        axes.semilogy(steps[rejected], chi2[rejected], "o", color="#1f5fa8", fillstyle="none", label="rejected step")
    distance = np.array([max(step.distance, 1e-12) for step in result.history])
    axes.semilogy(steps, distance, ".--", color="#c2571a", label="distance to the optimum, standard errors")
    for step, following in zip(result.history[:-1], result.history[1:], strict=True):
        if following.stage != step.stage:
            axes.axvline(following.step - 0.5, color="#888", linewidth=0.8)
    axes.set_xlabel("step")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(fontsize=8, frameon=False)
    axes.grid(alpha=0.25)
    return figure


def fitted_correlation(result: FitResult) -> tuple[list[str], Float[np.ndarray, "n n"]]:
    """Names and correlation matrix of the fitted numbers, without those that follow from them."""
    derived = {estimate.name for estimate in result.parameters if estimate.derived}
    kept = [number for number, name in enumerate(result.covariance_names) if name not in derived]
    return [result.covariance_names[number] for number in kept], result.correlation[np.ix_(kept, kept)]


def correlation_figure(result: FitResult) -> Figure:
    """Correlation matrix of the fitted numbers."""
    names, matrix = fitted_correlation(result)
    size = 2.6 + 0.2 * len(names)
    figure = Figure(figsize=(size + 0.6, size), layout="constrained")
    axes = figure.subplots()
    shown = axes.imshow(np.ma.masked_invalid(matrix), cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_facecolor(_MASKED)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    figure.colorbar(shown, ax=axes, shrink=0.7)
    return figure


def histogram_figure(result: FitResult) -> Figure:
    """Distribution of the residuals in sigmas against the normal one they should follow."""
    figure = Figure(figsize=(6.2, 3.4), layout="constrained")
    axes = figure.subplots()
    edges = np.linspace(-6, 6, 61)
    for observation, whitened in zip(result.observations, result.whitened, strict=True):
        axes.hist(
            np.clip(whitened[observation.used], -6, 6).ravel(),
            bins=list(edges),
            density=True,
            histtype="step",
            label=observation.name,
        )
    axes.plot(edges, np.exp(-(edges**2) / 2) / math.sqrt(2 * math.pi), "k--", linewidth=1, label="normal")
    axes.set_yscale("log")
    axes.set_ylim(1e-5, 1)
    axes.set_xlabel("(measured - fitted) / sigma")
    axes.legend(fontsize=8, frameon=False)
    return figure


# The page -----------------------------------------------------------------------------------------------------------

STYLE = """
:root { color-scheme: light; --ink: #1c2430; --soft: #5b6675; --line: #dde2e8; --good: #1b7f4b; --bad: #b3361b; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: .2rem; } h2 { font-size: 1.1rem; margin-top: 2.2rem; }
p, li { max-width: 48rem; } .soft, figcaption, caption { color: var(--soft); font-size: .9rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .18rem .8rem .18rem 0; text-align: right; border-bottom: 1px solid var(--line); }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; } tr.rule td { border-top: 2px solid var(--soft); }
.good { color: var(--good); } .bad { color: var(--bad); } figure { margin: 1rem 0; } img { max-width: 100%; }
.pair { display: flex; flex-wrap: wrap; gap: 1rem; align-items: start; } .pair figure { flex: 1 1 26rem; margin: 0; }
"""


def page(result: FitResult) -> str:
    """The report as one HTML document that needs nothing else."""
    wavelengths = [float(nm) for nm in result.atmosphere.wavelengths]
    scale = residual_scale(result.residuals)
    images = [
        figure_tag(image_figure(o, fitted, residual, wavelengths, scale), _caption(o, _image_record(result, number)))
        for number, (o, fitted, residual) in enumerate(
            zip(result.observations, result.fitted, result.residuals, strict=True)
        )
    ]
    seconds = ", ".join(f"{key.removesuffix('_s')} {value:.1f} s" for key, value in result.timings.items())
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>diffatmo fit</title><style>{STYLE}</style>",
        "<h1>Which atmosphere made this sky?</h1>",
        f"<p class={'good' if result.converged else 'bad'}><strong>{_verdict(result)}.</strong></p>",
        f"<p class=soft>{html.escape(result.message)}. Time: {seconds}.</p>",
        "".join(f"<p>{note}</p>" for note in _notes(result)),
        "<h2>Parameters</h2>",
        _html_table(result),
        "<h2>Images</h2>",
        *images,
        "<h2>Fit</h2><div class=pair>",
        figure_tag(
            convergence_figure(result),
            "Convergence. Lines part the passes: sigma from the measured signal, from the fitted one, and, where the model "
            "has one, the finer model. Each changes χ² a little.",
        ),
        figure_tag(histogram_figure(result), "Residuals in units of their standard deviation."),
        "</div>",
        figure_tag(correlation_figure(result), "Correlation of the fitted numbers."),
        "</html>",
    ]
    return "\n".join(parts)


def figure_tag(figure: Figure, caption: str) -> str:
    """A figure as HTML that needs no other file."""
    return f"<figure><img src='{_embed(figure)}' alt=''><figcaption>{html.escape(caption)}</figcaption></figure>"


def _caption(observation: Observation, about: dict[str, Any]) -> str:
    masked = ", ".join(f"{count} {reason}" for reason, count in observation.masked.items())
    median = ", ".join(f"{100 * value:.2g}" for value in about["residuals"]["median_absolute_relative"])
    of_sigma = ", ".join(f"{value:.2g}" for value in about["residuals"]["rms_sigma"])
    binned = f" (blocks of {observation.block} × {observation.block})" if observation.block > 1 else ""
    return (
        f"{observation.name}: sun at zenith angle {about['sun_zenith_deg']:.1f}°, azimuth "
        f"{about['sun_azimuth_deg']:.1f}°; altitude {observation.altitude:g} km; exposure {observation.exposure}; "
        f"{about['pixels_used']} pixels used{binned}{f', left out: {masked}' if masked else ''}. "
        f"Median |residual| per wavelength: {median} %; residual over stated noise, RMS: {of_sigma}."
    )


TIED = 0.99999
"""Correlation of numbers that are multiples of each other."""


def _notes(result: FitResult) -> list[str]:
    """In words, what a reader of the table must know."""
    notes = []
    if result.undetermined:
        notes.append(f"The images do not determine {html.escape(', '.join(result.undetermined))}.")
    if held := [e.name for e in result.parameters if e.at_bound]:
        notes.append(f"At the bound of the range: {html.escape(', '.join(held))}.")
    if result.error_scale > 1.05:
        notes.append(
            f"The residuals are {result.error_scale:.1f} times as large as the stated noise, and so are the standard "
            "errors. If the noise is right, the model does not describe the images as precisely as it should."
        )
    names, signed = fitted_correlation(result)
    matrix = np.abs(np.nan_to_num(signed))
    pairs = [
        (matrix[i, j], names[i], names[j])
        for i in range(len(matrix))
        for j in range(i)
        # Numbers that share one factor are one number.
        if 0.95 < matrix[i, j] < TIED
    ]
    if pairs:
        named = "; ".join(f"{a} and {b} ({r:.3f})" for r, a, b in sorted(pairs, reverse=True)[:6])
        notes.append(f"Determined well only in combination, as their strong correlation tells: {html.escape(named)}.")
    return notes


def _html_table(result: FitResult) -> str:
    columns = _columns(result)
    lines = ["<tr>" + "".join(f"<th>{getattr(_HEADINGS, name)}</th>" for name in columns) + "</tr>"]
    for row, estimate, rule in _rows(result):
        cells = {name: html.escape(getattr(row, name)) for name in columns}
        if estimate.pull is not None:
            cells["pull"] = f"<span class={'bad' if abs(estimate.pull) > FAR else 'good'}>{cells['pull']}</span>"
        line = "".join(f"<td>{cell}</td>" for cell in cells.values())
        lines.append(f"<tr{' class=rule' if rule else ''}>{line}</tr>")
    return "<table>" + "".join(lines) + "</table>"
