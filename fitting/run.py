"""A fit on its way: what has been done, what is left to be spent, and what is kept of it on disk."""

import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffatmo.numerics import array
from fitting._errors import FitError
from fitting.checkpoint import Checkpoint, Others, save
from fitting.elimination import starting
from fitting.evaluation import evaluated
from fitting.linearisation import Linearisation
from fitting.parameters import Coordinates
from fitting.problem import Linear, Problem
from fitting.search import Keep, Point, Progress, Step, minimise


@dataclass
class Run:
    """What the passes of a fit share."""

    tolerance: float
    max_steps: int
    progress: Progress | None
    checkpoint: Path | None
    identity: str
    history: list[Step] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    final: bool = False
    """Whether sigma comes from the fitted signal."""
    understated: float = 1.0
    """Factor between the residuals and the noise, where that matters."""
    others: Others = field(default_factory=Others)
    best: tuple[np.ndarray, float] | None = None
    """The best point of the present stage, and the step size there."""
    step_size: float | None = None
    """That of a search that was broken off, for the one that goes on; any other begins with its own."""

    def evaluate(self, x: Coordinates, linear: Linear, problem: Problem) -> Linearisation:
        """The linearisation at ``x``, timed."""
        before = time.perf_counter()
        result = evaluated(x, linear, problem)
        self.seconds.append(time.perf_counter() - before)
        return result

    def begin(self, x: Coordinates, problem: Problem) -> tuple[Coordinates, Linearisation]:
        """``y`` with a start for the linear nuisances, and the linearisation there."""
        found = self.evaluate(x, jnp.zeros(problem.batch.nuisances.linear, x.dtype), problem)
        linear = array(starting(np.asarray(found.radiance), problem.batch), x.dtype)
        # Residuals of another exposure are differences of large numbers, and the weights of a robust loss are those of one.
        if np.any(np.abs(linear) > (0.1 if problem.loss is None else 0)):
            found = self.evaluate(x, linear, problem)
        return jnp.concatenate([x, linear]), found

    def search(
        self,
        y: Coordinates,
        problem: Problem,
        tolerance: float,
        *,
        keep: Keep | None = None,
        steps: int = 0,
        **options: Any,
    ) -> Point:
        """A search from ``y`` in up to ``steps`` more; what a fit goes on from, if no other way to ``keep`` it is given."""
        step_size, self.step_size = (self.step_size if keep is None else None), None
        return minimise(
            y,
            problem,
            evaluate=self.evaluate,
            tolerance=tolerance,
            max_steps=len(self.history) + steps if steps else self.max_steps,
            history=self.history,
            progress=self.progress,
            keep=keep or self.keep,
            step_size=step_size,
            **options,
        )

    def keep(self, y: Coordinates, step_size: float) -> None:
        """Write the best point to the checkpoint."""
        self.best = np.asarray(y), step_size
        self._write()

    def keep_aside(self, number: int, y: Coordinates, _: float) -> None:
        """Write how far the search from another start, of this number, has come; it would go on with a step size of its own."""
        underway = list(self.others.underway)
        underway[number:] = [np.asarray(y).tolist(), *underway[number + 1 :]]
        self.others = self.others._replace(underway=underway)
        self._write()

    def _write(self) -> None:
        """Of several processes, which all come here with the same, one does."""
        if self.checkpoint is None or self.best is None or jax.process_index() > 0:
            return
        rows = [step._asdict() for step in self.history]
        state = Checkpoint(*self.best, self.max_steps, self.final, self.understated, self.others, rows)
        try:
            save(self.checkpoint, self.identity, state)
        except FitError as error:
            warnings.warn(f"{error}; the fit goes on without a checkpoint", stacklevel=2)
            self.checkpoint = None
