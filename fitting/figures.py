"""The figures of a fit: images, fits and residuals side by side, convergence, correlation, distribution of residuals."""

import io
import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from statistics import NormalDist
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from diffatmo import color, skymask
from diffatmo.numerics import array
from fitting.findings import NINETY_FIVE, ONE_SIGMA, Findings, Profile
from fitting.nuisances import channels
from fitting.observation import Observation

Image = Float[np.ndarray, "height width w"]


class Sheet(Figure):
    """A figure without pyplot that a notebook shows all the same."""

    def _repr_png_(self) -> bytes:
        return as_png(self)


DPI = 110


def as_png(figure: Figure) -> bytes:
    """A figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


TIED = 1e-6
"""How little less than fully correlated numbers are that a tie makes one."""

_MASKED = (0.82, 0.83, 0.85)
"""Grey of the pixels that were not used."""


def developed(
    observation: Observation, fitted: Image, wavelengths: Sequence[float]
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 3"]]:
    """The measured and the fitted image for a screen, through the same exposure and tone curve."""
    bands = array(wavelengths if observation.bands is None else observation.bands.centres)
    # In the shape of the image, whatever pixels are used, so that images of one size share one compiled program.
    used = array(np.where(observation.used[..., None], observation.image, np.nan))
    exposure = color.auto_exposure(color.to_linear_srgb(used, wavelengths=bands))

    def develop(image: Image) -> Float[np.ndarray, "height width 3"]:
        known = observation.shown[..., None] & np.isfinite(image).all(axis=-1, keepdims=True)
        rgb = color.display(array(np.where(known, image, 0)), wavelengths=bands, exposure=exposure)
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


def bare(axes: Axes, title: str) -> None:
    """A panel for a picture: a title, no ticks."""
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])


TINTS = dict(zip(skymask.REASONS, map(tuple, skymask.TINTS.tolist()), strict=True)) | {
    "below the horizon": (0.15, 0.15, 0.2),
    "near the sun": (1.0, 0.75, 0.45),
    "near the horizon": (0.6, 0.25, 0.9),
    "masked by the user": (1.0, 0.35, 0.65),
}
"""Colours of the reasons for which pixels of a photo are left out."""
_OTHER = (0.6, 0.6, 0.6)

LONG, SHORT = 1024, 600
"""Pixels of the longer side of a photo in a figure: at most, and what a small one is enlarged to."""
_TITLE, _LINE, _ENTRY, _GAP = 24, 20, 300, 10
"""Pixels of the height of a title and of a line of the legend, of the width of one of its entries, and between panels."""


def shares(left_out: Mapping[str, Bool[np.ndarray, "height width"]]) -> dict[str, str]:
    """In words, how much of a picture is fitted, and how much is left out for each reason."""
    parts = {reason: float(np.mean(bad)) for reason, bad in left_out.items()}
    parts = {"fitted": 1 - sum(parts.values())} | parts
    return {what: f"{100 * part:.2g} %" if part >= 1e-3 else "under 0.1 %" for what, part in parts.items()}


def mask_figure(
    pixels: Float[np.ndarray, "height width 3"], left_out: Mapping[str, Bool[np.ndarray, "height width"]]
) -> Figure:
    """A photo, and the same with what is left out of the fit painted by its reason; with the share of each in the picture.

    ``pixels`` are linear red, green, blue in any exposure; of ``left_out`` see :func:`fitting.observation.exclusions`.
    """
    label = np.zeros(pixels.shape[:2], dtype=np.uint8)
    for number, bad in enumerate(left_out.values(), start=1):
        label[bad] = number
    tints = np.array([(1.0, 1.0, 1.0), *(TINTS.get(reason, _OTHER) for reason in left_out)])
    codes = skymask.developed(pixels, label == 0)
    painted = skymask.painted(codes, label, tints)
    panels = {"the photo": _sized(codes), "what of it is fitted": _sized(painted)}
    height, width = panels["the photo"].shape[:2]
    # One pixel of the picture is one of the figure; a wide one stands above its mask, a high one beside it.
    rows, columns = (2, 1) if width > height else (1, 2)
    sheet = np.array([columns * width + (columns - 1) * _GAP, rows * (height + _TITLE)])
    entries = max(1, sheet[0] // _ENTRY)
    legend = _LINE * math.ceil(len(tints) / entries) + _GAP
    sheet[1] += legend
    figure = Sheet(figsize=tuple(sheet / DPI))
    for number, (title, picture) in enumerate(panels.items()):
        row, column = divmod(number, columns)
        corner = np.array([column * (width + _GAP), legend + (rows - 1 - row) * (height + _TITLE)])
        axes = figure.add_axes((*(corner / sheet), *(np.array([width, height]) / sheet)))
        axes.imshow(picture, interpolation="nearest", aspect="auto")
        bare(axes, title)
        axes.spines[:].set_visible(False)
    texts = [f"{what}, {share}" for what, share in shares(left_out).items()]
    # In its mean colour; what is in so few pixels that none of them is here, in its tint.
    faces = [painted[label == n].mean(axis=0) if np.any(label == n) else tint for n, tint in enumerate(tints)]
    handles = [
        Patch(facecolor=tuple(face), edgecolor="#666", label=text) for face, text in zip(faces, texts, strict=True)
    ]
    figure.legend(handles=handles, ncols=entries, loc="lower left", fontsize=8, frameon=False, borderpad=0.2)
    return figure


def _sized(codes: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "h w 3"]:
    """A picture with the longer side of :data:`LONG` pixels at most; of a small one every pixel several times."""
    from skimage import transform

    longer = max(codes.shape[:2])
    if longer > LONG:
        height, width = (max(1, round(side * LONG / longer)) for side in codes.shape[:2])
        return transform.resize(codes, (height, width), anti_aliasing=True)
    copies = max(1, SHORT // longer)
    return codes.repeat(copies, axis=0).repeat(copies, axis=1)


def is_scan(observation: Observation) -> bool:
    """Whether an image is a list of directions, which is no picture: it has a single row."""
    return len(observation.image) == 1


def image_figure(
    observation: Observation, fitted: Image, residual: Image, wavelengths: Sequence[float], scale: float
) -> Figure:
    """Measured, what of it is used, and fitted side by side; below the relative residual of each channel, if up to three."""
    if is_scan(observation):
        return _scan_figure(observation, fitted, residual, scale)
    names = channels(observation, wavelengths)
    unit = " nm" if observation.bands is None else ""
    panels = {f"residual, {name}{unit}": residual[..., i] for i, name in enumerate(names)}
    if len(panels) > 3:
        panels = {"residual, mean of all channels": np.mean(residual, axis=-1)}
    height, width = observation.used.shape
    rows = [height / width / 3, height / width / max(len(panels), 2)]
    figure = Sheet(figsize=(10, 10 * sum(rows) + 1.1), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=rows, squeeze=False)[:, 0]
    measured, expected = developed(observation, fitted, wavelengths)
    used = np.where(observation.used[..., None], measured, 0.3 * measured + 0.7 * np.array(_MASKED))
    shown = {"measured": measured, "what of it is fitted": used, "fitted": expected}
    for axes, (title, picture) in zip(above.subplots(1, 3), shown.items(), strict=True):
        axes.imshow(picture, interpolation="nearest")
        bare(axes, title)
    drawn = np.atleast_1d(below.subplots(1, len(panels)))
    for axes, (title, values) in zip(drawn, panels.items(), strict=True):
        axes.imshow(diverging(values, scale), interpolation="nearest")
        bare(axes, title)
    _residual_bar(below, list(drawn), scale)
    return figure


def _scan_figure(observation: Observation, fitted: Image, residual: Image, scale: float) -> Figure:
    """Samples of a scan where they look, with their residual; the mean spectrum, and the RMS residual of each band."""
    figure = Sheet(figsize=(10, 4.2), layout="constrained")
    used, directions = observation.used[0], observation.directions[0]
    azimuth, zenith = np.arctan2(directions[:, 0], directions[:, 1]), np.arccos(np.clip(directions[:, 2], -1, 1))
    sky: Any = figure.add_subplot(1, 2, 1, projection="polar")
    sky.set_theta_zero_location("N")
    sky.set_theta_direction(-1)
    sky.set_rlim(0, 90)
    sky.plot(azimuth[~used], np.degrees(zenith[~used]), "x", color="#999", label="left out")
    colours = diverging(np.mean(residual[0][used], axis=-1)[None], scale)[0]
    sky.scatter(azimuth[used], np.degrees(zenith[used]), c=colours, s=60, edgecolors="#666", linewidths=0.5)
    east, north, up = observation.sun
    sky.plot([np.arctan2(east, north)], [np.degrees(np.arccos(up))], "*", color="#e0a000", markersize=14, label="sun")
    sky.set_title("residual, mean of all channels", fontsize=9)
    sky.legend(fontsize=7, loc="lower left", bbox_to_anchor=(-0.2, -0.05))
    _residual_bar(figure, [sky], scale)
    spectra = figure.add_subplot(1, 2, 2)
    at = np.arange(observation.image.shape[-1]) if observation.bands is None else observation.bands.centres
    measured, expected = observation.image[0][used], fitted[0][used]
    spectra.plot(at, measured.mean(axis=0), color="#1f5fa8", label="measured, mean of all directions")
    spectra.plot(at, expected.mean(axis=0), "--", color="#c2571a", label="fitted")
    spectra.plot(at, np.sqrt(np.mean((expected - measured) ** 2, axis=0)), color="#888", label="RMS residual")
    spectra.set_xlabel("wavelength, nm" if observation.bands is not None else "channel")
    spectra.set_ylabel("radiance", fontsize=8)
    spectra.set_ylim(bottom=0)
    spectra.legend(fontsize=8, frameon=False)
    return figure


def _residual_bar(figure: FigureBase, axes: list[Axes], scale: float) -> None:
    """The colours of :func:`diverging` beside ``axes``."""
    norm = Normalize(-100 * scale, 100 * scale)
    bar = figure.colorbar(ScalarMappable(norm, "RdBu_r"), ax=axes, shrink=0.8, pad=0.01)
    bar.set_label("residual, %", fontsize=8)
    bar.ax.tick_params(labelsize=8)


def overview_figure(result: Findings) -> Figure:
    """A row for every image: measured, fitted, and the relative residual, mean of all channels."""
    wavelengths = [float(nm) for nm in result.atmosphere.wavelengths]
    scale, residuals = residual_scale(result.residuals), result.residuals
    heights = [observation.used.shape[0] / observation.used.shape[1] for observation in result.observations]
    figure = Sheet(figsize=(11, 3.4 * sum(heights) + 0.4 * len(heights)), layout="constrained")
    axes = figure.subplots(len(heights), 3, squeeze=False, height_ratios=heights)
    for row, observation, fitted, residual in zip(axes, result.observations, result.fitted, residuals, strict=True):
        pictures = (*developed(observation, fitted, wavelengths), diverging(np.mean(residual, axis=-1), scale))
        titles = (observation.name, "fitted", "residual, mean of all channels")
        for panel, picture, title in zip(row, pictures, titles, strict=True):
            panel.imshow(picture, interpolation="nearest")
            bare(panel, title)
    _residual_bar(figure, list(axes[:, 2]), scale)
    return figure


def convergence_figure(result: Findings) -> Figure:
    """Reduced χ² and the distance to the optimum against the step; rejected steps are hollow."""
    figure = Sheet(figsize=(6.2, 3.4), layout="constrained")
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


def profile_figure(profiles: Sequence[Profile]) -> Figure:
    """Δχ² against the value of each number, the parabola of its standard error, and the heights of 68 % and 95 %."""
    columns = min(len(profiles), 3)
    rows = math.ceil(len(profiles) / columns)
    figure = Sheet(figsize=(4.2 * columns, 3.2 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, profile in zip(panels, profiles, strict=False):
        _profile_panel(axes, profile)
    for axes in panels[len(profiles) :]:
        axes.set_axis_off()
    return figure


def _profile_panel(axes: Axes, profile: Profile) -> None:
    values = np.linspace(profile.points[0], profile.points[-1], 200)
    # Between the points as the intervals have it: the root, with the sign of the side, is linear.
    side = np.where(np.arange(len(profile.points)) < np.argmin(profile.delta_chi2), -1, 1)
    root = np.interp(values, profile.points, side * np.sqrt(np.maximum(profile.delta_chi2, 0)))
    axes.plot(values, root**2, color="#1f5fa8", label="profile")
    axes.plot(profile.points, profile.delta_chi2, "o", color="#1f5fa8", markersize=3.5)
    if profile.standard_error:
        parabola = ((values - profile.value) / profile.standard_error) ** 2
        axes.plot(values, parabola, "--", color="#888", linewidth=1, label="covariance")
    for level, colour in ((ONE_SIGMA, "#1b7f4b"), (NINETY_FIVE, "#c2571a")):
        height = NormalDist().inv_cdf((1 + level) / 2) ** 2
        axes.axhline(height, color=colour, linewidth=0.8)
        for end in profile.interval(level):
            if end is not None:
                axes.plot([end, end], [0, height], color=colour, linewidth=0.8)
        axes.annotate(f"{100 * level:.0f} %", (profile.points[0], height), fontsize=7, color=colour, va="bottom")
    axes.set_ylim(0, 10)
    axes.set_xlabel(profile.name + f", {profile.unit}" * bool(profile.unit), fontsize=9)
    axes.set_ylabel("Δχ²")
    axes.legend(fontsize=8, frameon=False)
    axes.tick_params(labelsize=8)


def _untied(result: Findings) -> tuple[list[str], Float[np.ndarray, "n n"]]:
    """The correlations of :attr:`~fitting.findings.Findings.fitted_correlation` between numbers that can differ."""
    names, matrix = result.fitted_correlation
    shown: dict[str, int] = {}
    for _, of_field in groupby(range(len(names)), key=lambda number: result.estimate(names[number]).field):
        numbers = list(of_field)
        one = len(numbers) > 1 and np.all(matrix[np.ix_(numbers, numbers)] > 1 - TIED)
        shown |= {result.estimate(names[n]).field if one else names[n]: n for n in (numbers[:1] if one else numbers)}
    kept = list(shown.values())
    return list(shown), matrix[np.ix_(kept, kept)]


def correlation_figure(result: Findings) -> Figure:
    """Correlation matrix of the fitted numbers; what a tie makes one number of a field is shown once, by the field's name."""
    names, matrix = _untied(result)
    size = 2.6 + 0.2 * len(names)
    figure = Sheet(figsize=(size + 0.6, size), layout="constrained")
    axes = figure.subplots()
    shown = axes.imshow(np.ma.masked_invalid(matrix), cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_facecolor(_MASKED)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    figure.colorbar(shown, ax=axes, shrink=0.7)
    return figure


def histogram_figure(result: Findings) -> Figure:
    """Distribution of the residuals in sigmas against the normal one they should follow."""
    figure = Sheet(figsize=(6.2, 3.4), layout="constrained")
    axes = figure.subplots()
    edges = np.linspace(-6, 6, 61)
    highest = 0.5
    for observation, whitened in zip(result.observations, result.whitened, strict=True):
        density, _, _ = axes.hist(
            np.clip(whitened[observation.used], -6, 6).ravel(),
            bins=list(edges),
            density=True,
            histtype="step",
            label=observation.name,
        )
        highest = max(highest, float(np.max(density)))
    axes.plot(edges, np.exp(-(edges**2) / 2) / math.sqrt(2 * math.pi), "k--", linewidth=1, label="normal")
    axes.set_yscale("log")
    axes.set_ylim(1e-5, 2 * highest)
    axes.set_xlabel("(measured - fitted) / sigma")
    axes.set_ylabel("share of the pixels per sigma")
    axes.legend(fontsize=8, frameon=False)
    return figure
