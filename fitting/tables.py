"""The numbers of a fit as tables: for a terminal, for a page, for other programs; and in words what must be known of them."""

import csv
import html
import io
import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text
from scipy.special import chdtri

from diffatmo import imageio
from diffatmo.atmosphere import Atmosphere
from fitting._errors import FitError
from fitting.combinations import combinations
from fitting.findings import NINETY_FIVE, ONE_SIGMA, Estimate, Findings, Minimum, Profile
from fitting.nuisances import EACH, channels
from fitting.observation import Observation
from fitting.priors import Prior
from fitting.quantities import REFERENCE_NM

SURPRISING, UNLIKELY = 0.01, 2.0
"""Probability below which what was found contradicts what was known beforehand, and standard errors from which a number is told
as one that does."""

MOVED = 6.0
"""Standard errors by which a finer model may move a number: beyond, in dense haze, it is off by half of the way itself."""

POOR = 0.1
"""Relative residuals of a photo, as a standard deviation, beyond those of clear skies."""

FAR = 3.0
"""Standard errors from the truth beyond which an estimate is marked."""

HEADLINE = {
    f"mie_optical_depth_{REFERENCE_NM:g}": f"aerosol optical depth at {REFERENCE_NM:g} nm",
    "mie_angstrom_exponent": "Ångström exponent of the aerosol",
    "visibility": "visibility at the ground",
    "turbidity": "turbidity",
}
"""Numbers that are asked for first, and what they are called."""

MANY = 12
"""Channels beyond which the median of their residuals is told instead of each."""

PLAIN_WIDTH = 100
"""Columns of the plain text: enough for the table with all its columns, and a number that is not determined."""


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
    images: str
    start: str
    truth: str
    pull: str


_HEADINGS = _Row("parameter", "unit", "nm", "fitted", "± error", "relative", "by images", "start", "truth", "pull")


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
        images="" if estimate.data_share is None else f"{100 * estimate.data_share:.0f} %",
        start="" if estimate.initial is None else f"{estimate.initial:.3g}",
        truth="" if estimate.truth is None else f"{estimate.truth:.5g}",
        pull="" if estimate.pull is None else f"{estimate.pull:+.1f}",
    )


def _rows(result: Findings) -> list[tuple[_Row, Estimate, bool]]:
    """All rows of the table, with what they show, and whether a rule goes above (a new kind of number begins).

    A field that is the same at all wavelengths, as one that a tie makes one number, has one row.
    """
    groups = [[e for e in result.parameters if e.derived == derived] for derived in (False, True)] + [result.nuisances]
    rows: list[tuple[_Row, Estimate, bool]] = []
    for number, group in enumerate(groups):
        began = len(rows)
        for _, of_field in groupby(group, key=lambda estimate: estimate.field):
            estimates = list(of_field)
            own = [_row(estimate, first=place == 0) for place, estimate in enumerate(estimates)]
            if len(own) > 1 and len({row._replace(parameter="", unit="", nm="") for row in own}) == 1:
                own = [own[0]._replace(nm="all")]
            for row, estimate in zip(own, estimates, strict=False):
                rows.append((row, estimate, len(rows) == began and number > 0))
    return rows


def _columns(result: Findings, without: Sequence[str] = ()) -> list[str]:
    """The columns that say something: truth where it is known, the images' share where there are priors."""
    empty = {*without, *(() if result.priors else ("images",))}
    if all(e.truth is None for e in result.parameters):
        empty |= {"truth", "pull"}
    return [name for name in _Row._fields if name not in empty]


def table(result: Findings, truth: Atmosphere | None = None) -> Table:
    """Fitted values, error bars and, where it is known, the truth, for a terminal of 80 columns."""
    if truth is not None:
        result = result.with_truth(truth)
    columns = _columns(result, without=("unit", "relative"))
    rich = Table(title=verdict(result), title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    rich.caption, rich.caption_justify = "Lengths in km, coefficients in 1/km.", "left"
    for name in columns:
        rich.add_column(getattr(_HEADINGS, name), justify="left" if name == "parameter" else "right")
    for row, estimate, rule in _rows(result):
        if rule:
            rich.add_section()
        far = estimate.pull is not None and abs(estimate.pull) > FAR
        rich.add_row(*(Text(getattr(row, name), style="red" if far and name == "pull" else "") for name in columns))
    return rich


def verdict(result: Findings) -> str:
    """How the fit ended, in one line."""
    state = "Converged" if result.converged else "Not converged"
    return f"{state} after {result.iterations} iterations, reduced χ² = {result.reduced_chi2:.3f}"


class _Headline(NamedTuple):
    """A number that stands above the table, as text."""

    what: str
    value: str
    images: str


def _headlines(result: Findings) -> list[_Headline]:
    """The numbers of :data:`HEADLINE` that the fit has."""
    found = []
    for estimate in result.parameters:
        if estimate.name not in HEADLINE:
            continue
        error = estimate.standard_error
        value = f"{format_number(estimate.value, error)} ± {error:.2g}" if error else format_number(estimate.value)
        value += f" {estimate.unit}" * bool(estimate.unit)
        value += ", at its bound" if estimate.at_bound else ", not determined" if error is None else ""
        share = estimate.data_share if result.priors else None
        images = "" if share is None else f"{100 * share:.0f} % by images"
        found.append(_Headline(HEADLINE[estimate.name], value, images))
    return found


def residual_text(observation: Observation, relative: Float[np.ndarray, " w"], wavelengths: Sequence[float]) -> str:
    """The residuals of an image in words, from the median of their absolute values, ``relative``, in each channel."""
    percent = 100 * relative
    told = "median |measured / fitted − 1|"
    if percent.size > MANY:
        return f"{told} of a channel {np.median(percent):.2g} %, at most {percent.max():.2g} %"
    unit = " nm" if observation.bands is None else ""
    names = channels(observation, wavelengths)
    return f"{told} " + ", ".join(f"{name}{unit} {value:.2g} %" for name, value in zip(names, percent, strict=True))


def _residual_lines(result: Findings) -> list[str]:
    """A line for each image."""
    wavelengths = [float(nm) for nm in result.atmosphere.wavelengths]
    several = len(result.observations) > 1
    lines = []
    for observation, residual in zip(result.observations, result.residuals, strict=True):
        median = np.median(np.abs(residual[observation.used].astype(float)), axis=0)
        of = f" of {observation.name}" * several
        lines.append(f"residuals{of}: {residual_text(observation, median, wavelengths)}")
    return lines


def overview(result: Findings) -> Group:
    """What stands above the table in a terminal: the numbers that are asked for first, and the residuals in percent."""
    grid = Table.grid(padding=(0, 3, 0, 0))
    for line in _headlines(result):
        grid.add_row(*map(Text, line))
    return Group(*([grid] if grid.rows else []), *map(Text, _residual_lines(result)))


def page_overview(result: Findings) -> str:
    """The same as HTML."""
    rows = "".join(
        f"<tr><td>{what}</td><td><strong>{value}</strong></td><td>{images}</td></tr>"
        for what, value, images in _headlines(result)
    )
    lines = "".join(f"<p>{html.escape(line)}</p>" for line in _residual_lines(result))
    return (f"<table>{rows}</table>" if rows else "") + lines


def _told_beforehand(result: Findings, prior: Prior) -> list[Estimate]:
    """The numbers that ``prior`` is about: of a nuisance, those of every image, of whose offsets it says the kind."""
    if prior.source != EACH:
        exact = [e for e in result.parameters if e.name == prior.name]
        return exact or [e for e in result.parameters if e.field == prior.name]
    heading = any(other.name == "pose_up_deg" for other in result.priors)
    kind = prior.name.removesuffix("_deg").removesuffix("_up")
    own = [e for e in result.nuisances if e.name.startswith(f"{kind}_")]
    if kind == "pose" and heading:
        return [e for e in own if e.name.endswith("_up_deg") == (prior.name == "pose_up_deg")]
    return own


def surprise(result: Findings) -> str | None:
    """What is improbable by all that was known beforehand, in words; None if it is not.

    The squares of (number - value) / error of the priors are of χ² with as many degrees of freedom if they are true; what is
    told here happens in one of a hundred fits. A prior on a field of numbers that are one is one.
    """
    total, count, far = 0.0, 0, list[tuple[float, str]]()
    for prior in result.priors:
        off: list[float] = []
        for estimate in _told_beforehand(result, prior):
            value = estimate.value
            if prior.relative and value <= 0:
                continue
            away = math.log(value / prior.value) if prior.relative else value - prior.value
            off.append(away / prior.error)
            if abs(off[-1]) > UNLIKELY:
                shown = format_number(value, estimate.standard_error)
                far.append((abs(off[-1]), f"{estimate.name} = {shown} ({prior}; {abs(off[-1]):.1f} standard errors)"))
        total += sum(x**2 for x in off)
        count += len({round(x, 3) for x in off})
    if not count or total < float(chdtri(count, SURPRISING)):
        return None
    told = "; ".join(text for _, text in sorted(far, reverse=True)[:4])
    above_all = f", above all {told}" if told else ""
    return (
        f"This is not what was known beforehand: χ² = {total:.0f} of {count} numbers{above_all}. Either that is wrong, or the "
        "images are not of a sky as the model has it, or their colours are not those of the light; the standard errors do not "
        "contain it."
    )


def doubts(result: Findings) -> list[str]:
    """In words, why the numbers may be wrong by more than their errors."""
    found = []
    if said := surprise(result):
        found.append(said)
    if result.error_scale > 1.05:
        found.append(
            f"The residuals are {result.error_scale:.1f} times as large as the stated noise, and so are the standard "
            "errors. If the noise is right, the model does not describe the images as precisely as it should."
        )
    if result.moved > MOVED:
        found.append(
            f"The model's finer self has moved a number by {result.moved:.0f} of its standard errors, and may be wrong by more "
            "than these say. Images with the sun elsewhere tell more; without the lowest degrees of the sky "
            "(horizon_exclusion_deg) less depends on the model."
        )
    for observation, residual in zip(result.observations, result.residuals, strict=True):
        # Of a photo the stated noise is that of few independent numbers, and hides what is wrong everywhere.
        typical = 1.48 * float(np.median(np.abs(residual[observation.used]), axis=0).max())
        if observation.bands is not None and len(observation.bands.names) == 3 and typical > POOR:
            found.append(
                f"{observation.name} differs from what was fitted by {100 * typical:.0f} %; clear skies do by some 5 %. It may "
                "show clouds, or what is no sky, or not be linear; the standard errors do not contain it."
            )
    return found


def notes(result: Findings) -> list[str]:
    """In words, what a reader of the table must know: first the doubts."""
    return [*doubts(result), *explanations(result)]


def explanations(result: Findings) -> list[str]:
    """In words, what a reader of the table must know besides the doubts."""
    found = list[str]()
    if result.undetermined:
        found.append(f"The images do not determine {', '.join(result.undetermined)}.")
    if held := [e.name for e in result.parameters if e.at_bound]:
        found.append(f"At the bound of the range: {', '.join(held)}.")
    if len(result.minima) > 1:
        others = "; ".join(minimum_text(result, minimum) for minimum in result.minima[1:])
        found.append(f"There are {len(result.minima)} minima, of which this is the best. Elsewhere: {others}.")
    if result.profiles:
        found.append(f"By profile likelihood: {'; '.join(profile_text(profile) for profile in result.profiles)}.")
    if result.priors:
        known = "; ".join(f"{prior} ({prior.source})" if prior.source else str(prior) for prior in result.priors)
        found.append(f"Known beforehand: {known}. The column 'by images' says how much of each precision is their own.")
    if sum(result.outliers):
        found.append(f"{sum(result.outliers)} pixels count for less than half, as outliers.")
    # Combinations are products of powers, which offsets and pedestals, of either sign, have no part in.
    signed = {e.name for e in result.nuisances if e.unit == "deg" or e.name.startswith("pedestal_")}
    kept = np.array([n for n, name in enumerate(result.covariance_names) if name not in signed], dtype=int)
    if said := [
        combination.text
        for combination in combinations(
            result.covariance[np.ix_(kept, kept)], [result.estimate(result.covariance_names[number]) for number in kept]
        )
    ]:
        found.append(f"Better known together than alone: {'; '.join(said[:6])}.")
    return found


def profile_text(profile: Profile) -> str:
    """A profile in words: its intervals, where they are open, and where they are not those of the covariance."""

    def between(level: float) -> str:
        low, high = profile.interval(level)
        width = (high if high is not None else profile.points[-1]) - (low if low is not None else profile.points[0])
        shown = ["?" if end is None else format_number(end, width / 2) for end in (low, high)]
        if low is None and high is None:
            return "open on both sides"
        if low is None or high is None:
            return f"below {shown[1]}" if low is None else f"above {shown[0]}"
        return f"{shown[0]} to {shown[1]}"

    said = f"{profile.name}: {between(ONE_SIGMA)} (68 %), {between(NINETY_FIVE)} (95 %)"
    if None in profile.interval(NINETY_FIVE):
        said += f", open where χ² does not rise enough between {profile.points[0]:.4g} and {profile.points[-1]:.4g}"
    if profile.standard_error is None:
        said += "; it has no standard error"
    elif profile.differs:
        value = format_number(profile.value, profile.standard_error)
        said += f"; not the {value} ± {profile.standard_error:.2g} of the covariance"
    if not profile.settled.all():
        said += f"; {int((~profile.settled).sum())} of {len(profile.points)} points did not converge"
    return said


def minimum_text(result: Findings, minimum: Minimum) -> str:
    """A minimum in words: its χ², and what is different there by more than :data:`FAR` standard errors."""
    errors = {e.name: e.standard_error for e in result.parameters}
    best = result.minima[0]
    moved = [
        f"{name} = {value:.4g}"
        for name, value in minimum.values.items()
        if (error := errors.get(name)) is not None and abs(value - best.values[name]) > FAR * error
    ]
    return f"χ² {minimum.chi2 / best.chi2:.3g} times as large at {', '.join(moved) or 'slightly other values'}"


def page_table(result: Findings) -> str:
    """The table as HTML."""
    columns = _columns(result)
    lines = ["<tr>" + "".join(f"<th>{getattr(_HEADINGS, name)}</th>" for name in columns) + "</tr>"]
    for row, estimate, rule in _rows(result):
        cells = {name: html.escape(getattr(row, name)) for name in columns}
        if estimate.pull is not None:
            cells["pull"] = f"<span class={'bad' if abs(estimate.pull) > FAR else 'good'}>{cells['pull']}</span>"
        line = "".join(f"<td>{cell}</td>" for cell in cells.values())
        lines.append(f"<tr{' class=rule' if rule else ''}>{line}</tr>")
    return "<table>" + "".join(lines) + "</table>"


def _remarks(result: Findings) -> list[str]:
    """What stands below the table: why the fit did not converge, if so, and the notes."""
    return [f"{result.message}."] * (not result.converged) + notes(result)


def text(result: Findings) -> str:
    """The overview, the table and the notes as plain text, for any display."""
    stream = io.StringIO()
    console = Console(
        file=stream, width=PLAIN_WIDTH, color_system=None, force_terminal=False, force_jupyter=False, highlight=False
    )
    console.print(overview(result), table(result), *_remarks(result), sep="\n", markup=False)
    return "\n".join(line.rstrip() for line in stream.getvalue().rstrip().splitlines())


def fragment(result: Findings) -> str:
    """How the fit ended, the overview, the table and the notes as HTML, for a notebook."""
    lines = [f"<p><strong>{verdict(result)}.</strong></p>", page_overview(result), page_table(result)]
    return "\n".join(lines + [f"<p>{html.escape(note)}</p>" for note in _remarks(result)])


def to_rows(result: Findings) -> list[dict[str, Any]]:
    """One row for each number, with None for what is not known; ``kind`` is ``fitted``, ``derived`` or ``nuisance``."""
    kinds = [("derived" if e.derived else "fitted", e) for e in result.parameters]
    return [
        {
            "name": estimate.name,
            "kind": kind,
            "field": estimate.field,
            "wavelength_nm": estimate.wavelength,
            "unit": estimate.unit,
            "value": estimate.value,
            "standard_error": estimate.standard_error,
            "data_share": estimate.data_share,
            "initial": estimate.initial,
            "truth": estimate.truth,
            "pull": estimate.pull,
            "at_bound": estimate.at_bound,
        }
        for kind, estimate in [*kinds, *(("nuisance", e) for e in result.nuisances)]
    ]


def write_csv(result: Findings, path: str | Path, *, overwrite: bool = False) -> None:
    """Write :func:`to_rows` as CSV, numbers with all their digits. Raises :class:`FitError` if it cannot be written."""
    rows = to_rows(result)
    try:
        with (
            imageio.atomic_write(path, overwrite=overwrite) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    except imageio.ImageError as error:
        raise FitError(str(error)) from error
