"""``diffatmo radiance``: radiance and transmittance of an atmosphere along a table of directions."""

import csv
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from diffatmo.cli.common import InputError, check_output, make_model, model_options, overwrite_option, read_atmosphere
from diffatmo.cli.keys import Number

if TYPE_CHECKING:
    import numpy as np
    from jax import Array

    from diffatmo.atmosphere import Atmosphere
    from diffatmo.models import Model, Sky

COLUMNS = {
    "altitude_km": Number("Height above the ground.", 0, 1e9),
    "sun_zenith_deg": Number("Zenith angle of the sun.", 0, 180),
    "view_zenith_deg": Number("Zenith angle of the view: 0 is up, 180 down.", 0, 180),
    "view_azimuth_deg": Number("Azimuth of the view relative to the sun's."),
}
"""The columns that are read."""

CHUNK = 4096
"""Rows computed at a time: bounds the memory, whatever the length of the table."""


@dataclass(frozen=True)
class Table:
    """A table of directions: its rows as they were written, and the numbers of ``COLUMNS`` in that order."""

    header: list[str]
    rows: list[list[str]]
    numbers: list[list[float]]


@click.command()
@click.argument("atmosphere", metavar="ATM.toml")
@click.argument("directions", metavar="DIRECTIONS.csv", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", metavar="OUT.csv", type=click.Path(path_type=Path), required=True, help="File to write."
)
@model_options
@click.option("--x64", is_flag=True, help="Compute in double precision.")
@overwrite_option
def radiance(
    atmosphere: str,
    directions: Path,
    output: Path,
    model: str,
    samples: int | None,
    seed: int | None,
    x64: bool,
    overwrite: bool,
) -> None:
    """Radiance along a table of directions.

    ATM.toml is an atmosphere file or the name of a preset. DIRECTIONS.csv has the columns altitude_km, sun_zenith_deg,
    view_zenith_deg and view_azimuth_deg, the azimuth relative to the sun's. OUT.csv repeats its rows in the same order,
    followed by radiance_<nm> and transmittance_<nm> for every wavelength, and stderr_<nm> for the path tracer. Sunlit
    and skylit ground is included where the ray meets it, the sun's disc is not.
    """
    check_output(output, overwrite=overwrite)
    table = read_table(directions)
    import jax

    with ExitStack() as stack:
        if x64:
            stack.enter_context(jax.enable_x64(True))
        air = read_atmosphere(atmosphere)
        chosen = make_model(model, samples=samples, seed=seed)
        columns = new_columns(air, chosen)
        taken = [name for name in columns if name in table.header]
        if taken:
            raise InputError(f"{directions}: has a column {taken[0]} already")
        values = compute(air, table, chosen)
    write_table(output, table, columns, values)


def read_table(path: Path) -> Table:
    """Read a table of directions; every number in it is checked."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [(number, row) for number, row in enumerate(csv.reader(file), start=1) if any(map(str.strip, row))]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV file: {error}") from error
    if not lines:
        raise InputError(f"{path}: empty, expected a header with {', '.join(COLUMNS)}")
    header = [name.strip() for name in lines[0][1]]
    for name in COLUMNS:
        if header.count(name) != 1:
            problem = "missing" if name not in header else "given more than once"
            raise InputError(f"{path}: column {name} {problem}; columns needed: {', '.join(COLUMNS)}")
    if len(lines) == 1:
        raise InputError(f"{path}: no rows below the header")
    rows = [row for _, row in lines[1:]]
    numbers = [_numbers(f"{path}: line {number}", header, row) for number, row in lines[1:]]
    return Table(header, rows, numbers)


def _numbers(where: str, header: list[str], row: list[str]) -> list[float]:
    if len(row) != len(header):
        raise InputError(f"{where}: {len(row)} values, expected {len(header)}")
    numbers = []
    for name, column in COLUMNS.items():
        text = row[header.index(name)].strip()
        try:
            numbers.append(column.read(float(text)))
        except ValueError as error:
            raise InputError(f"{where}: {name}: got {text!r}, expected {column.expected}") from error
    return numbers


def compute(atmosphere: "Atmosphere", table: Table, model: "Model") -> list[list[str]]:
    """What to add to each row, with the digits that its precision has."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from diffatmo.compiling import outermost

    altitude, sun_zenith, view_zenith, view_azimuth = np.asarray(table.numbers).T
    degrees = np.radians(np.stack([sun_zenith, view_zenith, view_azimuth]))
    sun = _direction(degrees[0], np.zeros_like(degrees[0]))
    view = _direction(degrees[1], degrees[2])

    # One shape, and so one compilation, serves every chunk; the last one is filled up with its last row.
    count = len(table.rows)
    chunks = -(-count // CHUNK)
    size = -(-count // chunks)
    sky = outermost(type(model).sky)(model, atmosphere)
    ask = outermost(_ask)
    parts = []
    for number in range(chunks):
        rows = np.minimum(np.arange(number * size, (number + 1) * size), count - 1)
        rays = [jnp.asarray(array[rows], jnp.result_type(float)) for array in (altitude, view, sun)]
        parts.append(jax.device_get(ask(sky, jnp.asarray(number), *rays)))
    values = np.concatenate([np.concatenate(part, axis=-1) for part in parts])[:count]
    return [[str(number) for number in row] for row in values]


def _ask(sky: "Sky", chunk: "Array", altitude: "Array", view: "Array", sun: "Array") -> "tuple[Array, ...]":
    """Radiance, transmittance and, for the path tracer, standard error along rays."""
    import jax

    from diffatmo.models.pathtrace import PathTraceSky

    if not isinstance(sky, PathTraceSky):
        return sky.radiance(altitude=altitude, view=view, sun=sun)
    # Chunks must not share random numbers, or their errors would be the same.
    key = jax.random.fold_in(sky.key, chunk)
    light, error, transmittance = sky.radiance_with_error(altitude=altitude, view=view, sun=sun, key=key)
    return light, transmittance, error


def new_columns(atmosphere: "Atmosphere", model: "Model") -> list[str]:
    """Names of the columns to add."""
    from diffatmo.atmosphere import to_dict
    from diffatmo.models import PathTrace

    quantities = ["radiance", "transmittance"] + ["stderr"] * isinstance(model, PathTrace)
    names = [label(wavelength) for wavelength in to_dict(atmosphere)["wavelengths_nm"]]
    return [f"{quantity}_{name}" for quantity in quantities for name in names]


def label(wavelength: float) -> str:
    """A wavelength in a column's name: as few digits as say it exactly, ``680`` for 680.0."""
    return str(int(wavelength)) if wavelength == int(wavelength) else repr(wavelength)


def _direction(zenith: "np.ndarray", azimuth: "np.ndarray") -> "np.ndarray":
    """Unit vectors in the local frame: x east, y north (here towards the sun), z up."""
    import numpy as np

    return np.stack([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)], axis=-1)


def write_table(path: Path, table: Table, columns: list[str], values: list[list[str]]) -> None:
    """Write the table's own columns as they were, then the new ones."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*table.header, *columns])
        writer.writerows([*row, *new] for row, new in zip(table.rows, values, strict=True))
