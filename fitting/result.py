"""What the user of a fit holds: all that it found, and all that can be done with it, from a notebook as from a program."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from matplotlib.figure import Figure

from diffatmo.models import Model
from diffatmo.render import Scene
from fitting import figures, storage, tables
from fitting._errors import FitError
from fitting.findings import Findings
from fitting.prediction import Prediction, predict

_FIGURES: dict[str, Callable[[Findings], Figure]] = {
    "images": figures.overview_figure,
    "residuals": figures.histogram_figure,
    "correlation": figures.correlation_figure,
    "convergence": figures.convergence_figure,
    "profiles": lambda result: figures.profile_figure(result.profiles),
}
"""What can be plotted."""


@dataclass(frozen=True, repr=False)
class FitResult(Findings):
    """What a fit found: the numbers of :class:`~fitting.findings.Findings`, and ways to look at them, keep them and use them.

    At the end of a notebook's cell it shows itself: the numbers that are asked for first, residuals in percent, and the table.
    """

    def __repr__(self) -> str:
        return tables.text(self)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return tables.fragment(self)

    @property
    def doubts(self) -> list[str]:
        """What makes the numbers doubtful, in sentences; none is no promise, but nothing that was looked for was found."""
        return tables.doubts(self)

    def plot(self, what: str = "images") -> Figure:
        """A figure, drawn without pyplot: ``figure.savefig("fit.pdf")``; a notebook shows it as it is.

        ``what`` is ``"images"`` (every image measured, fitted, and the residual), ``"residuals"`` (their distribution, in
        sigmas), ``"correlation"`` (of the fitted numbers), ``"convergence"``, or ``"profiles"`` (those that
        :func:`fitting.profile` has put into the result). Raises :class:`FitError` for anything else.
        """
        if what not in _FIGURES:
            raise FitError(f"plot: got {what!r}, expected one of {', '.join(_FIGURES)}")
        if what == "profiles" and not self.profiles:
            raise FitError("plot: the result has no profiles; fitting.profile(result, name) puts them in")
        return _FIGURES[what](self)

    def to_rows(self) -> list[dict[str, Any]]:
        """One row for every fitted, derived and nuisance number: its name, value, standard error, start, truth, pull, ….

        ``pandas.DataFrame(result.to_rows())`` is the table as a data frame; pandas itself is not needed here.
        """
        return tables.to_rows(self)

    def to_csv(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write :meth:`to_rows` as CSV with full precision; what is not known is empty. Raises :class:`FitError`."""
        tables.write_csv(self, path, overwrite=overwrite)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write everything into one file, ``fit.npz`` say, from which :meth:`load` reads it; see :mod:`fitting.storage`.

        A model of your own is not saved with it. Raises :class:`FitError`.
        """
        storage.save(self, path, overwrite=overwrite)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what :meth:`save` has written. Raises :class:`FitError` for any other file."""
        return storage.load(path, cls)

    def predict(self, scene: Scene, *, model: Model | None = None, exposure: str | None = None) -> Prediction:
        """The fitted atmosphere seen by the camera, from the altitude, under the sun and in the exposure of ``scene``.

        Gives the radiance and its standard error in every pixel, and compares them with an image that was not fitted; see
        :func:`fitting.prediction.predict`.
        """
        return predict(self, scene, model=model, exposure=exposure)
