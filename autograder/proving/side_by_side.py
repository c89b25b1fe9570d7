"""Call one function on many things, in processes of this machine or on a Dask cluster, and get the results as they end."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING, Generic, TypeVar

from experiments import pool

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")
PATIENCE = 30  # seconds that a scheduler may be away, at the start or later
ROUNDS = 3


class NoScheduler(OSError):
    """No scheduler answers, or not any more."""


@dataclass(frozen=True)
class Done(Generic[Item, Result]):
    """How one call ended: with a result, or with an error."""

    item: Item
    result: Result | None
    error: BaseException | None = None


def run(
    function: Callable[[Item], Result], items: Sequence[Item], jobs: int = 1, scheduler: str | None = None
) -> Iterator[Done[Item, Result]]:
    """Call `function` on each item, begun in their order.

    Args:
      function: of a module, so that other processes find it; so must the items and results be plain enough to travel.
      items: in the order in which they should begin, the longest first.
      jobs: calls at a time, each in a process of its own with one thread; one alone is made in this process.
      scheduler: address of a Dask scheduler whose workers share this file system; replaces `jobs`.

    Yields: a Done for each item, in the order of ending. A function that raises costs its own item only.
    Raises: NoScheduler if none answers at that address, or none any more, for PATIENCE seconds.
    """
    if scheduler:
        yield from _on_dask(function, items, scheduler)
    elif min(jobs, len(items)) > 1:
        yield from _here(function, items, min(jobs, len(items)))
    else:
        for item in items:
            try:
                yield Done(item, function(item))
            except Exception as error:
                yield Done(item, None, error)


def _here(function: Callable[[Item], Result], items: Sequence[Item], jobs: int) -> Iterator[Done[Item, Result]]:
    executor = ProcessPoolExecutor(jobs, get_context("spawn"), pool.begin)  # a forked child would share torch's state
    futures = {executor.submit(function, item): item for item in items}
    try:
        for future in as_completed(futures):
            yield _done(futures[future], future)
    finally:
        executor.shutdown(cancel_futures=True)


def _on_dask(function: Callable[[Item], Result], items: Sequence[Item], scheduler: str) -> Iterator[Done[Item, Result]]:
    """Every item ends once, however often the cluster runs it; what a scheduler took with it is handed to the next one."""
    from distributed import as_completed as as_they_end  # a second of imports that a local run need not pay

    left, fruitless = dict(enumerate(items)), 0
    while left:
        before = len(left)
        with _client(scheduler) as client:
            futures = {client.submit(function, item, pure=False, retries=1): number for number, item in left.items()}
            for future in as_they_end(futures):
                with suppress(CancelledError):  # the scheduler is gone, and knows nothing of it when it is back
                    done: Done[Item, Result] = _done(left[futures[future]], future)
                    del left[futures[future]]
                    yield done
        fruitless = fruitless + 1 if len(left) == before else 0
        if left and fruitless == ROUNDS:
            raise NoScheduler(f"the Dask scheduler at {scheduler} was lost {ROUNDS} times before anything had come of it")


def _client(scheduler: str) -> Client:
    """Raises NoScheduler if none answers in time."""
    from distributed import Client

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # that a connection is lost is told in one line of ours
    try:
        return Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        reason = f"none answered within {PATIENCE} s" if isinstance(error, OSError) else str(error)
        raise NoScheduler(f"no Dask scheduler at {scheduler}: {reason}") from error


def _done(item: Item, future: Future) -> Done[Item, Result]:
    error = future.exception()
    return Done(item, None if error else future.result(), error)
