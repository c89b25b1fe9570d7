"""The judge's side of forkserver.py: a process that has torch loaded and forks a sealed one for each submission.

    server = forking.course.get()                 # one in a process, for all its threads
    with Sandbox(script, files=files, server=server) as sandbox: …

The kernel may not allow it: a Sandbox without a server works wherever bubblewrap does, and takes a second or more of a processor longer.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import subprocess
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from autograder import paths
from autograder.grading import bubblewrap, seccomp

INSIDE = Path(__file__).with_name("forkserver.py")
PYTHON_OPTIONS = ("-P", "-s", "-S", "-B")  # the standard library's path only, no bytecode; -I would ignore PYTHONHASHSEED
FOLDERS = ("/course", "/site", "/work")  # sys.path after the standard library
PRELOADED = (
    "torch",
    "torch.fx.experimental.symbolic_shapes",  # and sympy, half a second, with a process's first gradient
    "matplotlib.pyplot",
    "course_lib.chapters",
    "course_lib.checks.magics",
    "course_lib.checks.names",
    "course_lib.checks.notebook",
    "course_lib.checks.observing",
    "course_lib.checks.stored",
)
START_TIMEOUT = 120.0  # seconds until torch is loaded, on a busy machine
PATIENCE = 3  # refusals until a server is given up
ANSWER_TIMEOUT = 10.0  # seconds until a server that is ready has forked; they are a submission's own


class Refused(Exception):
    """There is no server, or it could not make a process; the text says why."""


class ForkServer:
    """A process in a sandbox of its own that never sees a byte of a submission. Threads may share it.

    Args:
      modules: files and folders that appear as /course/<their name>.
      preload: modules to load before the first fork.

    Raises: Refused if bubblewrap cannot be started. What goes wrong later, `fork` says.
    """

    def __init__(self, modules: Sequence[Path], preload: Sequence[str] = PRELOADED) -> None:
        self.modules = [Path(module) for module in modules]
        self._lock = threading.Lock()
        self._ready = self.hangs = False
        self._socket, theirs = socket.socketpair()
        complaints, complaints_in = os.pipe()
        self._complaints = os.fdopen(complaints, "rb")
        passed = [theirs.fileno()]
        try:
            boot = json.dumps([theirs.fileno(), FOLDERS, list(preload)])
            command = ["/python/bin/python", *PYTHON_OPTIONS, "-c", INSIDE.read_text(encoding="utf-8"), boot]
            words, arguments = bubblewrap.around_server(self.modules)
            command = [*words, *bubblewrap.handed_over(arguments, passed), *command]
            self._process = subprocess.Popen(
                command, env={}, cwd="/", stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=complaints_in,
                pass_fds=passed, start_new_session=True,
            )  # fmt: skip
        except (OSError, NotImplementedError) as error:
            self._socket.close()
            self._complaints.close()
            raise Refused(f"no server: {error}") from error
        finally:
            theirs.close()
            os.close(complaints_in)
            for descriptor in passed[1:]:
                os.close(descriptor)

    def wait_until_ready(self) -> None:
        """Raises Refused if the server has not come up."""
        with self._lock:
            if self._ready:
                return
            self._socket.settimeout(START_TIMEOUT)
            try:
                self._ready = self._socket.recv(1) == b"+"
                self._socket.settimeout(ANSWER_TIMEOUT)
            except OSError as error:
                self.close()
                raise Refused(f"the server did not start: {error}") from error
            if not self._ready:
                raise Refused(f"the server did not start: {self._complaint()}")

    def _complaint(self) -> str:
        self.close(keep_complaints=True)
        with self._complaints:
            return self._complaints.read(4000).decode(errors="replace").strip() or "it said nothing"

    def fork(self, channel: int, complaints: int, request: dict[str, Any], handed: Sequence[int]) -> Leash:
        """A new process that runs a script.

        Args:
          channel, complaints: descriptors that it gets: its socket, and a pipe for what goes wrong until it says so there.
          request: what forkserver.py reads: name, sizes, files and limits.
          handed: descriptors of the script and of each file.
        """
        self.wait_until_ready()
        ours, theirs = socket.socketpair()
        try:
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
            with theirs, self._lock:
                socket.send_fds(self._socket, [b"f"], [channel, theirs.fileno(), complaints])
            return Leash(ours, request | {"filter": seccomp.program().hex()}, handed)
        except (OSError, psutil.Error, NotImplementedError) as error:
            ours.close()
            self.hangs = self.hangs or isinstance(error, TimeoutError)
            raise Refused(f"the server does not answer: {error}") from error

    def close(self, keep_complaints: bool = False) -> None:
        """End the server. What it has forked ends with its sandbox."""
        self._socket.close()
        if not keep_complaints:
            self._complaints.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=2)
        self._process.kill()
        self._process.wait()


class Shared:
    """This process's own server, for all its threads: made when it is first asked for, and given up where it cannot work."""

    def __init__(self, make: Callable[[], ForkServer]) -> None:
        self._make, self._lock = make, threading.Lock()
        self._server: ForkServer | None = None
        self._former: ForkServer | None = None
        self._refusals = 0
        self.given_up = ""  # why

    def begin(self) -> None:
        """Start it, without waiting until it is ready."""
        with self._lock:
            if self._server is None and not self.given_up:
                try:
                    self._server = self._make()
                except Refused as error:
                    self.given_up = str(error)

    def get(self) -> ForkServer | None:
        """It, ready; None if it has been given up."""
        self.begin()
        if self._server is not None:
            try:
                self._server.wait_until_ready()
            except Refused as error:
                self._give_up(str(error))
        return self._server

    def refused(self, why: str) -> None:
        """It did not fork, though a process of its own began: a machine may lack a process once, but not again and again."""
        self._refusals += 1
        if self._refusals >= PATIENCE or (self._server and self._server.hangs):
            self._give_up(why)

    def _give_up(self, why: str) -> None:
        """Have none from here on; what the one there was has forked lives on."""
        with self._lock:
            self._former, self._server, self.given_up = self._server or self._former, None, why


course = Shared(lambda: ForkServer([paths.COURSE_LIB]))


class Leash:
    """What subprocess.Popen is for a child: a process that a server has forked, and how it ends. Let go, and everything in it dies."""

    def __init__(self, end: socket.socket, request: dict[str, Any], handed: Sequence[int]) -> None:
        self._end = end
        self._status: int | None = None
        end.settimeout(ANSWER_TIMEOUT)
        word, credentials, _, _ = end.recvmsg(1, socket.CMSG_SPACE(struct.calcsize("3i")))
        if not (word and credentials):
            raise OSError("it has ended")
        # The kernel says who wrote the word, as this process would call it, and whoever did waits for the next one.
        self.root = psutil.Process(struct.unpack("3i", credentials[0][2])[0])
        text = json.dumps(request).encode()
        end.sendall(len(text).to_bytes(8, "big"))
        end.sendall(text[socket.send_fds(end, [text], handed) :])
        end.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 0)

    def wait(self, timeout: float | None = None) -> int:
        """How it ended, as a shell says it. subprocess.TimeoutExpired if it has not, after `timeout` seconds."""
        if self._status is None:
            if not select.select([self._end], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("a forked process", timeout or 0)
            word = b""
            with suppress(OSError):
                word = self._end.recv(1)
            self._status = word[0] if word else 1
        return self._status

    def kill(self) -> None:
        """Let go, and see that it is noticed."""
        with suppress(OSError):
            self._end.shutdown(socket.SHUT_WR)
        try:
            self.wait(timeout=2)
        except subprocess.TimeoutExpired:
            with suppress(psutil.Error):
                self.root.kill()

    def close(self) -> None:
        self._end.close()
