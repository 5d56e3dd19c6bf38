"""One table of many fits: a row for each image, out of the record that its fit has left."""

import csv
import io
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from diffatmo.cli.common import printable

FILE = "results.csv"
RECORD = "fit.json"
COLUMNS = ("file", "status", "message", "doubts", "reduced_chi2", "residual_percent", "seconds")
"""Of every row; ``residual_percent`` is the median of abs(measured / fitted - 1) in the channel where it is largest. Then come
the numbers that were fitted and what follows from them, each with its standard error."""

STATES = CONVERGED, NOT_CONVERGED, FAILED = "converged", "not converged", "failed"

Row = dict[str, Any]


def row(file: Path, directory: Path) -> Row | None:
    """The row of the image ``file`` out of the record in ``directory``; None if there is none that can be read."""
    try:
        record = json.loads((directory / RECORD).read_text(encoding="utf-8"))
        return {
            "file": printable(file),
            "status": CONVERGED if record["converged"] else NOT_CONVERGED,
            "message": record["message"],
            "doubts": " ".join(record["doubts"]),
            "reduced_chi2": record["reduced_chi2"],
            "residual_percent": 100 * max(record["images"][0]["residuals"]["median_absolute_relative"]),
            "seconds": round(record["timings"]["total_s"], 3),
            **_numbers(record),
        }
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None


def failure(file: Path, message: str) -> Row:
    """The row of an image that could not be fitted."""
    return {"file": printable(file), "status": FAILED, "message": printable(message)}


def _numbers(record: Mapping[str, Any]) -> dict[str, float | None]:
    """Every number and its standard error, by name, for each wavelength where there are several."""
    image = record["images"][0]["name"]
    numbers: dict[str, float | None] = {}
    for group, entries in record.items():
        for field, entry in entries.items() if isinstance(entries, dict) else ():
            if not isinstance(entry, dict) or not {"value", "standard_error"} <= entry.keys():
                continue
            values, errors = entry["value"], entry["standard_error"]
            if isinstance(values, list):
                names = [f"{field}_{nm:g}" for nm in record["wavelengths_nm"]]
            else:
                # A nuisance of the image's own bears its name, and is the same column for all images.
                own = group not in ("parameters", "derived")
                names = [re.sub(rf"_{re.escape(image)}(?=_|$)", "", field, count=1) if own else field]
                values, errors = [values], [errors]
            for name, value, error in zip(names, values, errors, strict=True):
                numbers |= {name: value, f"{name}_standard_error": error}
    return numbers


def dumps(rows: Iterable[Row]) -> str:
    """The rows as CSV: the columns of all of them; what a row does not have, or is not determined, is empty."""
    rows = list(rows)
    columns = dict.fromkeys([*COLUMNS, *(name for row in rows for name in row)])
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
