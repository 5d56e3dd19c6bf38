"""Work done in processes of their own, one item at a time each: one that dies takes nothing along but its item.

The processes are spawned, not forked, as JAX's threads do not survive a fork. They leave Ctrl-C to their parent, and end
with it, however it ends.
"""

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")
R = TypeVar("R")

PATIENCE_S = 10.0
"""Time that a process is given to end by itself."""


class Died(NamedTuple):
    """A process ended while it worked on an item."""

    exit_code: int | None
    """Negative: the signal that killed it."""

    def __str__(self) -> str:
        if self.exit_code is None or self.exit_code >= 0:
            return f"its process ended with exit status {self.exit_code}; what it wrote to the terminal says why"
        try:
            name = signal.Signals(-self.exit_code).name
        except ValueError:
            name = "unknown"
        why = ", perhaps for want of memory" if name == "SIGKILL" else ""
        return f"its process was ended by signal {-self.exit_code} ({name}){why}"


class _Worker(NamedTuple):
    process: BaseProcess
    connection: Connection

    @classmethod
    def start(cls, work: Callable[[Any], Any]) -> "_Worker":
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(work, theirs), daemon=True)
        with _without_interrupts():
            process.start()
        # Only the child holds its end now, so ours tells when it is gone.
        theirs.close()
        return cls(process, ours)

    def give(self, item: Any) -> None:
        # If it is dead already, that is what the answer will say.
        with suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(item)

    def answer(self) -> Any:
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self.end()
            return Died(self.process.exitcode)

    def end(self) -> None:
        """Let an idle process end; one that does not is made to."""
        self.connection.close()
        self.process.join(PATIENCE_S)
        if self.process.is_alive():
            self.kill()

    def kill(self) -> None:
        self.process.kill()
        self.process.join()


def each(work: Callable[[T], R], items: Sequence[T], *, jobs: int) -> Generator[tuple[int, R | Died], None, None]:
    """The position of each of ``items`` and what ``work`` makes of it, in the order in which they are done.

    Up to ``jobs`` processes work at a time; one that dies is replaced. ``work`` must be a function that can be imported;
    items and results must be such as can be pickled. Whoever stops asking stops the processes.
    """
    waiting = deque(enumerate(items))
    idle: list[_Worker] = []
    busy: dict[Connection, tuple[_Worker, int]] = {}
    done: list[tuple[int, R | Died]] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < jobs:
                index, item = waiting.popleft()
                worker = idle.pop() if idle else _Worker.start(work)
                busy[worker.connection] = worker, index
                worker.give(item)
            # Only now, so that no process waits for what is done with the results.
            yield from done
            done = []
            ready = wait(list(busy))
            for connection in [connection for connection in busy if connection in ready]:
                worker, index = busy.pop(connection)
                answer = worker.answer()
                done.append((index, answer))
                if not isinstance(answer, Died):
                    idle.append(worker)
        yield from done
    finally:
        for worker, _ in busy.values():
            worker.kill()
        for worker in idle:
            worker.end()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Ctrl-C waits until the end of the block; a process started in it never hears of it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Started with the first process, it would let interrupts through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(work: Callable[[Any], Any], connection: Connection) -> None:
    """What a process does: one item after another, until its parent has no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            item = connection.recv()
        except EOFError:
            return
        connection.send(work(item))


def _end_with_parent() -> None:
    """A parent that was killed cannot end its children, so they watch it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
