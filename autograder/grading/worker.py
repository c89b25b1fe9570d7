"""Runs inside the sandbox: executes a learner's cells, then calls their functions on the inputs that the judge sends.

Nothing here is trusted once learner code has run, and nothing here is secret: there is no expected value in this process. The judge
reads answers as plain arrays and compares them in its own process.

The conversation, in frames of course_lib.checks.stored.encode, over the stream socket whose number is sys.argv[1]:

    worker  {"ready": true}
    judge   {"cells": [[number, source, "whole", "definitions" or "live"], …]}
    worker  {"running": number} before each cell, then {"loaded": {number: notebook.Stop as a dict}}
    judge   {"exercise": name, "seconds": s, "cases": [arguments of observe, …]}
    worker  {"observations": […], "uses": [name, …]} | {"missing": true} | {"ended": "timeout" or "exit"}

Of a cell that can't be run only its definitions are; of a live one, those that other cells mention. Each exercise is called in a forked
child, so that what it does to its process is gone with it; pools of threads and processes that the cells left are made anew there.
"""

import gc
import os
import select
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict

# Until the worker is ready, nothing that was handed in may be found: torch imports what is optional (opt_einsum) and what any
# *.dist-info on the path announces (torch.backends), and a learner's file of that name would run before the judge counts on it.
HANDED_IN = sys.path.pop()  # the sandbox names it last

gc.disable()  # while hundreds of modules are made, there is nothing to collect; importing torch is most of a grading's cost
import torch  # noqa: E402

from course_lib.checks.magics import without_debuggers  # noqa: E402
from course_lib.checks.names import used_by  # noqa: E402
from course_lib.checks.notebook import new_namespace, run_cell, run_definitions, stop, wanted_of_live  # noqa: E402
from course_lib.checks.observing import observe  # noqa: E402
from course_lib.checks.stored import decode, encode  # noqa: E402

gc.enable()

ANSWERED = 86  # how a child ends that has answered; os._exit(0) in a learner's function is no answer


class Channel:
    """Frames over a stream socket: eight bytes of length, then that many bytes."""

    def __init__(self, number: int) -> None:
        self._socket = socket.socket(fileno=number)

    def send(self, data) -> None:
        payload = encode(data)
        self._socket.sendall(len(payload).to_bytes(8, "big") + payload)

    def receive(self):
        return decode(self._read(int.from_bytes(self._read(8), "big")))

    def _read(self, count: int) -> bytes:
        chunks = []
        while count:
            chunk = self._socket.recv(min(count, 1 << 20))
            if not chunk:
                os._exit(0)  # the judge is done with us
            chunks.append(chunk)
            count -= len(chunk)
        return b"".join(chunks)


def load(channel: Channel, cells: list) -> dict:
    """Run the cells in order in one namespace; tell the judge before each, so that it knows which one hung or ended the process."""
    namespace = new_namespace()
    live = [source for _, source, how in cells if how == "live"]
    wanted = wanted_of_live(live, [source for _, source, how in cells if how != "live"], namespace) if live else set()
    failures = {}
    for number, source, how in cells:
        channel.send({"running": number})
        try:
            if how == "whole":
                run_cell(source, namespace, f"cell {number}")
            else:
                run_definitions(source, namespace, f"cell {number}", wanted if how == "live" else None)
        except BaseException as error:  # whatever a cell raises, the next one runs
            if how != "live":
                failures[number] = asdict(stop(error, source, namespace, f"cell {number}"))
    channel.send({"loaded": failures})
    return namespace


def pools_left() -> list:
    """The pools of threads and processes that the cells have made and used: those have threads."""
    if threading.active_count() == 1:
        return []
    places = {"concurrent.futures.thread": "ThreadPoolExecutor", "concurrent.futures.process": "ProcessPoolExecutor"}
    places["multiprocessing.pool"] = "Pool"  # and its ThreadPool
    kinds = tuple(getattr(sys.modules[module], name) for module, name in places.items() if module in sys.modules)
    return [thing for thing in gc.get_objects() if issubclass(type(thing), kinds)] if kinds else []


def renew(pool) -> None:
    """Make a pool anew, in a child where its threads are gone; what its processes have not done yet is lost."""
    from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
    from multiprocessing.pool import Pool, ThreadPool

    if isinstance(pool, ThreadPoolExecutor) and not pool._shutdown:
        ThreadPoolExecutor.__init__(pool, pool._max_workers, pool._thread_name_prefix, pool._initializer, pool._initargs)  # type: ignore
    elif isinstance(pool, ProcessPoolExecutor) and not pool._shutdown_thread:  # type: ignore[attr-defined]
        ProcessPoolExecutor.__init__(pool, pool._max_workers, pool._mp_context, pool._initializer, pool._initargs)  # type: ignore
    elif isinstance(pool, Pool) and pool._state == "RUN":  # type: ignore[attr-defined]
        given = (pool._processes, pool._initializer, pool._initargs)  # type: ignore[attr-defined]
        if isinstance(pool, ThreadPool):
            ThreadPool.__init__(pool, *given)  # type: ignore[misc]
        else:
            Pool.__init__(pool, *given, pool._maxtasksperchild, pool._ctx)  # type: ignore


def answer(channel: Channel, request: dict, namespace: dict, pools: list) -> None:
    """Call one exercise in a forked child, for `seconds` at most."""
    child = os.fork()
    if child == 0:
        call(channel, request, namespace, pools)
    ended = wait(child, request["seconds"])
    if ended:
        channel.send({"ended": ended})


def wait(child: int, seconds: float) -> str:
    """Wait for a child; kill it after `seconds`. Returns "" if it has answered, "timeout" or "exit"."""
    in_time = ended_within(child, seconds)
    if not in_time:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return "timeout" if not in_time else "" if os.waitstatus_to_exitcode(status) == ANSWERED else "exit"


def ended_within(child: int, seconds: float) -> bool:
    """Wait for a child without reaping it."""
    try:
        handle = os.pidfd_open(child)
    except OSError:  # a kernel that has no such handles, as gVisor's
        until = time.monotonic() + seconds
        while not (ended := os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT)) and time.monotonic() < until:
            time.sleep(0.002)
        return ended is not None
    in_time = select.select([handle], [], [], seconds)[0]
    os.close(handle)
    return bool(in_time)


def call(channel: Channel, request: dict, namespace: dict, pools: list) -> None:
    """In the child: observe the function on every case, answer, and end without running anybody's clean-up."""
    torch.set_num_threads(1)  # a pool of threads does not survive a fork
    status = 1
    try:
        for pool in pools:
            with suppress(Exception):
                renew(pool)
        function = namespace.get(request["exercise"])
        if callable(function):
            uses: list = []
            with suppress(Exception):
                uses = used_by(function, namespace)
            seen = [asdict(observe(function, **case)) for case in request["cases"]]
            channel.send({"observations": seen, "uses": uses})
        else:
            channel.send({"missing": True})
        status = ANSWERED
    finally:
        os._exit(status)


def main() -> None:
    torch.set_num_threads(1)
    channel = Channel(int(sys.argv[1]))
    without_debuggers()
    channel.send({"ready": True})
    sys.path += [HANDED_IN, ""]  # and wherever a cell goes
    namespace = load(channel, channel.receive()["cells"])
    pools = pools_left()
    while True:
        answer(channel, channel.receive(), namespace, pools)


if __name__ == "__main__":
    main()
