"""Runs inside the sandbox: executes a learner's cells, then calls their functions on the inputs that the judge sends.

Nothing here is trusted once learner code has run, and nothing here is secret: there is no expected value in this process. The judge
reads answers as plain arrays and compares them in its own process.

The conversation, in frames of course_lib.checks.stored.encode, over the stream socket whose number is sys.argv[1]:

    worker  {"ready": true}
    judge   {"cells": [[number, source, whether all of it or only what it defines], …]}
    worker  {"running": number} before each cell, then {"loaded": {number: error text}}
    judge   {"exercise": name, "seconds": s, "cases": [arguments of observe, …]}
    worker  {"observations": […]} | {"missing": true} | {"ended": "timeout" or "exit"}

Each exercise is called in a forked child, so that what it does to its process is gone with it.
"""

import gc
import os
import select
import signal
import socket
import sys
from dataclasses import asdict

# Until the worker is ready, nothing that was handed in may be found: torch imports what is optional (opt_einsum) and what any
# *.dist-info on the path announces (torch.backends), and a learner's file of that name would run before the judge counts on it.
HANDED_IN = sys.path.pop()  # the sandbox names it last

gc.disable()  # while hundreds of modules are made, there is nothing to collect; importing torch is most of a grading's cost
import torch  # noqa: E402

from course_lib.checks.notebook import new_namespace, run_cell, run_definitions  # noqa: E402
from course_lib.checks.observing import observe, text_of  # noqa: E402
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
    failures = {}
    for number, source, whole in cells:
        channel.send({"running": number})
        try:
            (run_cell if whole else run_definitions)(source, namespace, f"cell {number}")
        except BaseException as error:  # whatever a cell raises, the next one runs
            failures[number] = f"{type(error).__name__}: {text_of(error)}"
    channel.send({"loaded": failures})
    return namespace


def answer(channel: Channel, request: dict, namespace: dict) -> None:
    """Call one exercise in a forked child, for `seconds` at most."""
    child = os.fork()
    if child == 0:
        call(channel, request, namespace)
    ended = wait(child, request["seconds"])
    if ended:
        channel.send({"ended": ended})


def wait(child: int, seconds: float) -> str:
    """Wait for a child; kill it after `seconds`. Returns "" if it has answered, "timeout" or "exit"."""
    handle = os.pidfd_open(child)
    in_time = select.select([handle], [], [], seconds)[0]
    if not in_time:
        os.kill(child, signal.SIGKILL)
    os.close(handle)
    _, status = os.waitpid(child, 0)
    return "timeout" if not in_time else "" if os.waitstatus_to_exitcode(status) == ANSWERED else "exit"


def call(channel: Channel, request: dict, namespace: dict) -> None:
    """In the child: observe the function on every case, answer, and end without running anybody's clean-up."""
    torch.set_num_threads(1)  # a pool of threads does not survive a fork
    status = 1
    try:
        function = namespace.get(request["exercise"])
        if callable(function):
            seen = [asdict(observe(function, **case)) for case in request["cases"]]
            channel.send({"observations": seen})
        else:
            channel.send({"missing": True})
        status = ANSWERED
    finally:
        os._exit(status)


def main() -> None:
    torch.set_num_threads(1)
    channel = Channel(int(sys.argv[1]))
    channel.send({"ready": True})
    sys.path.append(HANDED_IN)
    namespace = load(channel, channel.receive()["cells"])
    while True:
        answer(channel, channel.receive(), namespace)


if __name__ == "__main__":
    main()
