"""Call one function on many things, in processes of this machine or on a Dask cluster, and get the results as they end."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from queue import Empty, Queue
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from experiments import pool

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")
PATIENCE = 30  # seconds that a scheduler may be away, at the start or later
HIRING = 120  # seconds that a scheduler may be without any worker
LOOK = 5  # seconds without news, after which it is looked whether somebody works
FETCH = 30  # seconds that a worker may take to hand over a result
ROUNDS = 3  # times that all may be lost


class NoScheduler(OSError):
    """No scheduler answers, or not any more, or it has no workers."""


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
    Raises: NoScheduler if none answers at that address, or none any more, for PATIENCE seconds, or it has no worker for HIRING.
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
    """Every item ends once, however often the cluster runs it; what a scheduler or a worker took with it is handed out again."""
    left, fruitless = dict(enumerate(items)), 0
    while left:
        before = len(left)
        with _client(scheduler) as client:
            for number, done in _as_they_end(client, function, left, scheduler):
                del left[number]
                yield done
        fruitless = fruitless + 1 if len(left) == before else 0
        if left and fruitless == ROUNDS:
            raise NoScheduler(
                f"the Dask scheduler at {scheduler} or its workers were lost {ROUNDS} times before anything had come of it"
            )


def _as_they_end(
    client: Client, function: Callable[[Item], Result], left: Mapping[int, Item], scheduler: str
) -> Iterator[tuple[int, Done[Item, Result]]]:
    """What ends while this scheduler lives. Nothing here waits without limit: a worker may be gone, or say nothing, at any moment."""
    ended: Queue[Any] = Queue()
    waiting = {client.submit(function, item, pure=False, retries=1): number for number, item in left.items()}
    for future in waiting:
        future.add_done_callback(ended.put)
    alive = _Alive(client, scheduler)
    while waiting:
        try:
            future = ended.get(timeout=LOOK)
        except Empty:
            if alive.lost():
                return
            continue
        number = waiting.pop(future)
        try:
            done: Done[Item, Result] = _done(left[number], future, FETCH)
        except (OSError, CancelledError):  # who held the result is gone, or says nothing: it is made again in the next round
            continue
        yield number, done


class _Alive:
    """Looks whether somebody is there to work."""

    def __init__(self, client: Client, scheduler: str) -> None:
        self._client, self._scheduler = client, scheduler
        self._answered = self._worked = time.monotonic()

    def lost(self) -> bool:
        """Whether the scheduler has not answered for PATIENCE seconds. Raises: NoScheduler if it had no worker for HIRING seconds."""
        now = time.monotonic()
        asked = self._client.scheduler
        if asked is None:  # the client has given it up by itself
            return True
        try:
            workers = self._client.sync(asked.ncores, callback_timeout=LOOK)
        except (OSError, TimeoutError):
            return now - self._answered > PATIENCE
        self._answered = now
        if workers:
            self._worked = now
        elif now - self._worked > HIRING:
            raise NoScheduler(
                f"no worker has joined {self._scheduler} for {HIRING} s: start one with `dask worker {self._scheduler}`"
            )
        return False


@contextmanager
def _client(scheduler: str) -> Iterator[Client]:
    """Raises NoScheduler if none answers in time."""
    from distributed import Client  # a second of imports that a local run need not pay

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # that a connection is lost is told in one line of ours
    try:
        with ThreadPoolExecutor(1) as aside:  # apart from any event loop of this thread
            aside.submit(asyncio.run, _greet(scheduler)).result()
        client = Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        reason = f"none answered within {PATIENCE} s" if isinstance(error, OSError) else str(error)
        raise NoScheduler(f"no Dask scheduler at {scheduler}: {reason}") from error
    try:
        yield client
    finally:
        with suppress(OSError):  # from one that says nothing, no farewell is waited for
            client.close(timeout=LOOK)


async def _greet(scheduler: str) -> None:
    """Returns when the scheduler has answered once; a Client would wait without limit for one that takes the call and says nothing."""
    from distributed.core import rpc

    async with asyncio.timeout(PATIENCE), rpc(scheduler, timeout=PATIENCE) as called:
        await called.identity()


def _done(item: Item, future: Future, patience: float | None = None) -> Done[Item, Result]:
    error = future.exception(patience)
    return Done(item, None if error else future.result(patience), error)
