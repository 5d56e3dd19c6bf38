"""What a fit leaves behind: a machine-readable record, the atmosphere, pictures, and one page to look at.

:func:`write` puts into a directory

- ``fit.json``, described below,
- ``fit.npz``, from which ``FitResult.load`` has everything again, to predict with or to look at (:mod:`fitting.storage`),
- ``atmosphere.toml``, the fitted atmosphere as every other command reads it,
- ``fitted_<image>.exr`` and ``.png``, what the images should look like, and ``residual_<image>.exr`` and ``.png``,
  measured / fitted - 1,
- of a scan, whose pixels are no picture, ``fitted_<image>.png`` alone: what was measured and fitted, and where it differs,
- ``profile_<name>.png`` of every profile likelihood,
- what the caller adds: figures (:class:`Plate`), for which ``mask.png`` and names that begin with ``mask_`` are reserved,
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
                      ``data_share`` (the part of its precision that comes from the images, not from priors),
                      ``initial``, ``truth`` (null: unknown), ``pull`` = (value - truth) / standard_error, ``at_bound``;
                      each a number, or a list for a spectral field
``derived``           the same for optical depths and single scattering albedo
``nuisances``         the same for what else the images depend on (:mod:`fitting.nuisances`), by name: factors of exposure,
                      white balance and focal length; pedestals, in units of the image; offsets of sun and camera, in degrees
``priors``            ``name``, ``value``, ``error``, ``relative`` (of the logarithm), ``source`` of each
``doubts``            in words, why numbers may be wrong by more than their errors; empty if nothing says so
``undetermined``      names of the numbers that the images do not determine
``covariance``        ``names`` and ``matrix`` (of all numbers above), ``correlation`` likewise
``profiles``          for each profile likelihood: ``name``, ``unit``, ``value``, ``standard_error``, ``points`` (values of
                      the number), ``delta_chi2``, ``settled``, ``bounded`` (whether the first and the last point are where
                      the range ends), ``interval_68`` and ``interval_95`` (null: open on that side), ``differs`` (from that
                      of the standard error)
``minima``            ``chi2`` and ``values`` of each, the best first, if the search found several
``images``            for each: place, sun as given, which nuisances are free, how many exposures it was merged
                      from, masked pixels by reason, pixels that a robust loss takes for outliers, ``colours`` (of red, green
                      and blue bands, how light at ``wavelengths_nm`` becomes pixels: ``response``, then ``factor``, then
                      purity by the coefficient ``saturation``), ``noise_relative`` (as stated: per wavelength the median of
                      sigma / fitted), and ``residuals``: per wavelength the median and the root mean square of
                      measured / fitted - 1, the median of its absolute value, and the root mean square in sigmas
``timings``           seconds: ``compile_s``, ``solve_s``, ``total_s``
====================  ================================================================================================
"""

import base64
import html
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from diffatmo import atmosphere, folders, imageio, scene, sun
from diffatmo.atmosphere import Atmosphere
from diffatmo.bands import COLOURS
from diffatmo.numerics import array
from diffatmo.render import Scene
from fitting import storage
from fitting._errors import FitError
from fitting.figures import (
    Image,
    as_png,
    convergence_figure,
    correlation_figure,
    developed,
    diverging,
    histogram_figure,
    image_figure,
    is_scan,
    profile_figure,
    residual_scale,
)
from fitting.findings import NINETY_FIVE, ONE_SIGMA, Estimate, Findings
from fitting.nuisances import KINDS
from fitting.observation import FIXED, PER_CHANNEL, Observation
from fitting.storage import installed_version
from fitting.tables import (
    MANY,
    doubts,
    explanations,
    overview,
    page_overview,
    page_table,
    profile_text,
    residual_text,
    table,
    verdict,
)

__all__ = [
    "STYLE",
    "Plate",
    "check_writable",
    "doubts",
    "figure_tag",
    "file_names",
    "overview",
    "page",
    "record",
    "scene_of",
    "table",
    "write",
]

SCHEMA, SCHEMA_VERSION = "diffatmo-fit", 2

FIXED_NAMES = ("fit.json", "fit.npz", "atmosphere.toml", "report.html", "mask.png")
IMAGE_PREFIXES = ("fitted_", "residual_", "profile_", "mask_")


class Plate(NamedTuple):
    """A figure that the caller has of what was fitted: a file of the report, and the first thing on its page."""

    file: str
    figure: Figure
    caption: str


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
    result: Findings,
    directory: str | Path,
    *,
    truth: Atmosphere | None = None,
    plates: Sequence[Plate] = (),
    overwrite: bool = False,
) -> list[Path]:
    """Write all files of the report, ``plates`` among them, and return their paths.

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

    def exr(pixels: Image, of: Observation, shot: Scene | None) -> Callable[[Path], None]:
        if shot is not None:
            return lambda file: scene.save(file, pixels, shot, overwrite=overwrite)
        bands = wavelengths if of.bands is None else None if len(of.bands.names) == 3 else of.bands.centres
        return lambda file: imageio.write_exr(file, pixels, wavelengths=bands, overwrite=overwrite)

    def chart(figure: Figure) -> Callable[[Path], None]:
        def task(file: Path) -> None:
            with imageio.atomic_write(file, overwrite=overwrite) as temporary:
                temporary.write_bytes(as_png(figure))

        return task

    tasks = {
        "fit.json": text(lambda: json.dumps(record(result), indent=1, allow_nan=False) + "\n"),
        "fit.npz": lambda file: storage.save(result, file, overwrite=overwrite),
        "atmosphere.toml": text(lambda: atmosphere.dumps(result.atmosphere)),
    }
    for name, observation, fitted, residual in zip(
        file_names(result.observations), result.observations, result.fitted, result.residuals, strict=True
    ):
        tasks[f"fitted_{name}.exr"] = exr(fitted, observation, scene_of(result, observation))
        tasks[f"residual_{name}.exr"] = exr(residual, observation, None)
        if is_scan(observation):
            tasks[f"fitted_{name}.png"] = chart(image_figure(observation, fitted, residual, wavelengths, scale))
        else:
            tasks[f"fitted_{name}.png"] = png(developed(observation, fitted, wavelengths)[1])
            tasks[f"residual_{name}.png"] = png(diverging(np.mean(residual, axis=-1), scale))
    for profile in result.profiles:
        tasks[f"profile_{profile.name}.png"] = chart(profile_figure([profile]))
    for plate in plates:
        tasks[plate.file] = chart(plate.figure)
    tasks["report.html"] = text(lambda: page(result, plates))
    failures = []
    for file, task in tasks.items():
        try:
            task(path / file)
        except (OSError, ValueError) as error:
            failures.append(str(error))
    if failures:
        raise OSError("; ".join(failures))
    return [path / file for file in tasks]


def scene_of(result: Findings, observation: Observation) -> Scene | None:
    """The scene of a fitted image; None if its pixels are not the camera's, or more than one exposure and the sky, or bands."""
    others = {getattr(observation, kind) for kind in KINDS if kind != "exposure"}
    several = observation.block > 1 or observation.exposure.endswith(PER_CHANNEL) or observation.bands is not None
    if several or others != {FIXED}:
        return None
    return Scene(
        atmosphere=result.atmosphere,
        camera=observation.camera,
        altitude=array(observation.altitude),
        sun=array(observation.sun),
        exposure=array(float(result.exposure(observation)[0])),
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
    keys = ("value", "standard_error", "data_share", "initial", "truth", "pull", "at_bound")
    result: dict[str, dict[str, Any]] = {}
    for field, members in fields.items():
        columns = {key: [getattr(member, key) for member in members] for key in keys}
        spectral = members[0].wavelength is not None
        result[field] = {"unit": members[0].unit} | {k: v if spectral else v[0] for k, v in columns.items()}
    return result


def record(result: Findings) -> dict[str, Any]:
    """The contents of ``fit.json``; see the head of this module."""
    return _finite(
        {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "version": installed_version(),
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
            "nuisances": _by_field(result.nuisances),
            "doubts": doubts(result),
            "undetermined": result.undetermined,
            "priors": [asdict(prior) for prior in result.priors],
            "covariance": {"names": result.covariance_names, "matrix": result.covariance},
            "correlation": {"names": result.covariance_names, "matrix": result.correlation},
            "profiles": [
                asdict(profile)
                | {
                    "interval_68": profile.interval(ONE_SIGMA),
                    "interval_95": profile.interval(NINETY_FIVE),
                    "differs": profile.differs,
                }
                for profile in result.profiles
            ],
            "minima": [asdict(minimum) for minimum in result.minima],
            "images": [_image_record(result, number) for number in range(len(result.observations))],
            "history": [step._asdict() for step in result.history],
            "timings": result.timings,
        }
    )


def _sun_degrees(observation: Observation) -> tuple[float, float]:
    """Zenith angle and azimuth (clockwise from north) of the sun."""
    zenith, azimuth = sun.angles(array(observation.sun))
    return math.degrees(zenith), math.degrees(azimuth)


def _colours(result: Findings, observation: Observation) -> dict[str, Any] | None:
    """How the camera saw the light, of an image whose channels are red, green and blue."""
    bands = observation.bands
    if bands is None or bands.names != COLOURS:
        return None
    return {
        "wavelengths_nm": bands.nodes,
        "response": bands.response,
        "factor": result.exposure(observation),
        "saturation": result.saturation(observation),
        "encoded": observation.tone != FIXED,
    }


def _image_record(result: Findings, number: int) -> dict[str, Any]:
    observation = result.observations[number]
    zenith, azimuth = _sun_degrees(observation)
    relative = result.residuals[number][observation.used].astype(float)
    whitened = result.whitened[number][observation.used].astype(float)
    fitted = result.fitted[number][observation.used].astype(float)
    stated = result.noise[number][observation.used] / np.where(fitted > 0, fitted, np.nan)
    return {
        "name": observation.name,
        "altitude_km": observation.altitude,
        "sun_zenith_deg": zenith,
        "sun_azimuth_deg": azimuth,
        **{kind: getattr(observation, kind) for kind in KINDS},
        "exposure_value": observation.exposure_value,
        "colours": _colours(result, observation),
        "merged_from": observation.merged,
        "pixels_used": len(relative),
        "pixels_masked": observation.masked,
        "pixels_outlying": result.outliers[number] if result.outliers else 0,
        "binning": observation.block,
        "noise_relative": np.median(stated, axis=0),
        "residuals": {
            "median_relative": np.median(relative, axis=0),
            "median_absolute_relative": np.median(np.abs(relative), axis=0),
            "rms_relative": np.sqrt(np.mean(relative**2, axis=0)),
            "rms_sigma": np.sqrt(np.mean(whitened**2, axis=0)),
        },
    }


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


def page(result: Findings, plates: Sequence[Plate] = ()) -> str:
    """The report as one HTML document that needs nothing else."""
    wavelengths = [float(nm) for nm in result.atmosphere.wavelengths]
    scale = residual_scale(result.residuals)
    images = [
        figure_tag(
            image_figure(o, fitted, residual, wavelengths, scale),
            _caption(o, fitted, _image_record(result, number), wavelengths),
        )
        for number, (o, fitted, residual) in enumerate(
            zip(result.observations, result.fitted, result.residuals, strict=True)
        )
    ]
    seconds = ", ".join(f"{key.removesuffix('_s')} {value:.1f} s" for key, value in result.timings.items())
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>diffatmo fit</title><style>{STYLE}</style>",
        "<h1>Which atmosphere made this sky?</h1>",
        f"<p class={'good' if result.converged else 'bad'}><strong>{verdict(result)}.</strong></p>",
        f"<p class=soft>{html.escape(result.message)}. Time: {seconds}.</p>",
        page_overview(result),
        *(f"<p class=bad>{html.escape(doubt)}</p>" for doubt in doubts(result)),
        *(figure_tag(plate.figure, plate.caption) for plate in plates),
        *(f"<p>{html.escape(text)}</p>" for text in explanations(result)),
        "<h2>Parameters</h2>",
        page_table(result),
        *_profile_section(result),
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


def _profile_section(result: Findings) -> list[str]:
    if not result.profiles:
        return []
    words = "".join(f"<li>{html.escape(profile_text(profile))}.</li>" for profile in result.profiles)
    caption = (
        "Δχ² where one number is held and all others are fitted again, against the parabola of its standard error. Where it is "
        "below a line, the number is inside that interval."
    )
    return ["<h2>Profile likelihood</h2>", f"<ul>{words}</ul>", figure_tag(profile_figure(result.profiles), caption)]


def figure_tag(figure: Figure, caption: str) -> str:
    """A figure as HTML that needs no other file."""
    picture = base64.b64encode(as_png(figure)).decode("ascii")
    return f"<figure><img src='data:image/png;base64,{picture}' alt=''><figcaption>{html.escape(caption)}</figcaption></figure>"


def _residuals_text(
    observation: Observation, fitted: np.ndarray, about: dict[str, Any], wavelengths: Sequence[float]
) -> str:
    """The residuals of an image in words: of each channel, or, of a spectrometer's many, of all of them."""
    relative, of_sigma = (np.asarray(about["residuals"][key]) for key in ("median_absolute_relative", "rms_sigma"))
    noise = 100 * np.asarray(about["noise_relative"])
    told = f"Residuals: {residual_text(observation, relative, wavelengths)}"
    if relative.size > MANY:
        used = observation.used
        off = math.sqrt(np.mean((fitted - observation.image)[used].astype(float) ** 2))
        return (
            f"{told}; RMS {off:.2g} of a mean of {observation.image[used].mean(dtype=float):.2g} in the units of the "
            f"measurement; over stated noise ({np.median(noise):.2g} %), RMS: {np.sqrt(np.mean(of_sigma**2)):.2g}."
        )
    over = ", ".join(f"{value:.2g}" for value in of_sigma)
    return f"{told}; over stated noise ({', '.join(f'{value:.2g}' for value in noise)} %), RMS: {over}."


def _caption(observation: Observation, fitted: np.ndarray, about: dict[str, Any], wavelengths: Sequence[float]) -> str:
    masked = ", ".join(f"{count} {reason}" for reason, count in observation.masked.items())
    merged = f"merged from {observation.merged} files; " if observation.merged > 1 else ""
    binned = f" (blocks of {observation.block} × {observation.block})" if observation.block > 1 else ""
    choices = {kind.replace("_", " "): getattr(observation, kind) for kind in KINDS}
    free = ", ".join(f"{kind} {choice}" for kind, choice in choices.items() if kind == "exposure" or choice != FIXED)
    outlying = f" ({about['pixels_outlying']} of them outliers)" if about["pixels_outlying"] else ""
    return (
        f"{observation.name}: {merged}sun at zenith angle {about['sun_zenith_deg']:.1f}°, azimuth "
        f"{about['sun_azimuth_deg']:.1f}°; altitude {observation.altitude:g} km; {free}; "
        f"{about['pixels_used']} pixels used{binned}{outlying}{f', left out: {masked}' if masked else ''}. "
        f"{_residuals_text(observation, fitted, about, wavelengths)}"
    )
