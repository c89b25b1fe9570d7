"""Call one function on many things, in processes of this machine or on a Dask cluster, and get the results as they end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Generic, TypeVar

from experiments import pool

Item = TypeVar("Item")
Result = TypeVar("Result")


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
    Raises: OSError if there is no scheduler at that address.
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
    from distributed import Client  # a second of imports that a local run need not pay
    from distributed import as_completed as as_they_end

    with Client(scheduler, timeout="30s") as client:
        futures = {client.submit(function, item, pure=False, retries=1): item for item in items}
        for future in as_they_end(futures):
            yield _done(futures[future], future)


def _done(item: Item, future: Future) -> Done[Item, Result]:
    error = future.exception()
    return Done(item, None if error else future.result(), error)
