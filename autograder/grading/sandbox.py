"""A Python process that cannot see or touch anything but what it is given: bubblewrap around a learner's code.

    with Sandbox(script, modules=[course_lib], files={"policy.pt": path}) as sandbox:
        sandbox.send(request)
        answer = sandbox.receive(timeout=60)

Inside, `script` runs as `/course/<name>` with `sys.argv[1]` the number of a stream socket to the judge; a frame is its length
(8 bytes, big-endian) and that many bytes. It sees the interpreter (/python), the packages of `course_lib.checks.packages`
with what they need (/site), `modules` (/course, read-only), `files` in its working directory (/work, a small tmpfs), the
system's libraries, and nothing else of the host: no network, no other process, no environment. Standard streams are /dev/null,
for what a learner prints in a CI log could be a workflow command. `sys.path` is the standard library, /course, /site, /work:
files handed in can be imported but shadow nothing.

Whatever fails before `script` starts is ours (`SandboxUnavailable`); whatever fails later is the learner's: `SandboxTimeout`,
`SandboxDied`, `SandboxGarbage`. After any of them the sandbox is of no use; close it.

Use a Sandbox in the thread that opened it: bubblewrap's --die-with-parent follows that thread, not the process.

The wall is bubblewrap's, on this machine's kernel; `wall="gvisor"` puts gVisor there instead, and all else is as said above.
"""

import json
import os
import shutil
import signal
import site
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import psutil

from autograder.grading import bubblewrap, forking, gvisor, seccomp
from autograder.grading.bubblewrap import ENVIRONMENT, Limits, MiB
from autograder.grading.forking import PYTHON_OPTIONS, ForkServer, Leash

MAX_FRAME = 64 * MiB
MAX_FILES = 200  # each is an open descriptor of ours while the sandbox starts
MAX_FILES_SIZE = 256 * MiB  # together; they lie in memory
START_TIMEOUT = 60.0  # seconds until the interpreter runs; only an overloaded machine needs more than 0.2
TICK = 0.2  # seconds between two looks at the memory
WALLS = ("bubblewrap", "gvisor")

# Runs first inside. Limits are set here, not outside, because RLIMIT_NPROC counts per user namespace and would count strangers
# there. The one byte tells the judge that everything that is ours has worked.
BOOTSTRAP = """
import json, os, resource, runpy, sys
fd, script, path, limits = json.loads(sys.argv[1])
for name, value in limits.items():
    resource.setrlimit(getattr(resource, name), (value, value))
if limits:
    with open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")
os.write(fd, b"+")
for standard in (0, 1, 2):
    os.dup2(os.open(os.devnull, os.O_RDWR), standard)
os.closerange(3, fd)
os.closerange(fd + 1, 1 << 16)
sys.path += path
sys.argv = [script, str(fd)]
runpy.run_path(script, run_name="__main__")
"""


class SandboxError(Exception):
    """Any failure of a sandbox."""


class SandboxUnavailable(SandboxError):
    """No sandbox can be started on this machine; the text says how to enable it."""


class SandboxTimeout(SandboxError):
    """The learner's process did not answer, or did not listen, in time."""


class SandboxDied(SandboxError):
    """The learner's process ended, was killed for its memory, or hung up; the text says which."""


class SandboxGarbage(SandboxError):
    """The learner's process announced a frame above MAX_FRAME."""


@dataclass(frozen=True)
class Problem:
    what: str
    remedy: str


def _open_regular(path: Path) -> int:
    """A descriptor, so that nothing that happens to the path later matters. ValueError unless a regular file (links are not)."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        raise ValueError(f"cannot hand {path.name} to the sandbox: {error.strerror}") from error
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise ValueError(f"cannot hand {path.name} to the sandbox: not a regular file")
    return fd


def _require_readable(course: Sequence[Path]) -> None:
    """SandboxUnavailable if one of `course` is for root only (a checkout made under a strict umask): inside runs nobody."""
    for path in course:
        if not path.stat().st_mode & stat.S_IROTH:
            mend = f"chmod -R go+rX {path.resolve().parent}"
            raise SandboxUnavailable(
                f"The sandbox does not start: only root can read {path}, and inside runs nobody. Run `{mend}`."
            )


# --- the process ----------------------------------------------------------------------------------------------------


class Sandbox:
    """One process in its own sandbox; use it as a context manager.

    Args:
      script: the program, a host file; runs as /course/<its name>.
      modules: files and folders that appear as /course/<their name>.
      files: name relative to /work → regular file of the host (copied when the sandbox starts).
      limits: see Limits.
      server: forks the process, instead of starting it anew; then `modules` are those that it was given, and the file system is laid
        out alike. The sandbox then lives as long as it is open, whatever becomes of the thread.
      trusted: run one's own code in an ordinary subprocess instead. Nothing is confined and no limit holds.
      wall: one of WALLS. In gVisor nothing is forked by a server, and files and sockets count as the memory that they take.

    Raises: SandboxUnavailable on entering; ValueError for a file or a name that intake should have refused: not a regular
    file, not a plain relative name, more than MAX_FILES or MAX_FILES_SIZE.
    """

    def __init__(
        self,
        script: Path,
        modules: Sequence[Path] = (),
        files: Mapping[str, Path] | None = None,
        limits: Limits = Limits(),  # noqa: B008 (frozen)
        trusted: bool = False,
        server: ForkServer | None = None,
        wall: str = "bubblewrap",
    ) -> None:
        if wall not in WALLS:
            raise ValueError(f"no wall is called {wall!r}: take one of {', '.join(WALLS)}")
        self.wall = "" if trusted else wall
        self.script, self.modules, self.files = Path(script), [Path(module) for module in modules], dict(files or {})
        self.limits, self.trusted, self.server = limits, trusted, server
        for name in self.files:
            parts = PurePosixPath(name).parts
            if not parts or name.startswith("/") or ".." in parts or "\0" in name or str(PurePosixPath(name)) != name:
                raise ValueError(f"not a plain relative name: {name!r}")
        if len(self.files) > MAX_FILES:
            raise ValueError(f"{len(self.files)} files; at most {MAX_FILES} can be handed to the sandbox")
        self._process: subprocess.Popen | Leash | None = None
        self._root: psutil.Process | None = None  # above all processes inside
        self._socket: socket.socket | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        self._looked = float("inf")  # at the memory; not before the learner's code runs

    def __enter__(self) -> "Sandbox":
        self._socket, theirs = socket.socketpair()
        errors, errors_in = os.pipe()
        # bwrap's complaints go to a pipe that nobody reads once the learner runs: /proc/1/fd/2 inside then leads nowhere.
        try:
            with theirs, os.fdopen(errors, "rb") as complaints:
                try:
                    self._start(theirs.fileno(), errors_in)
                finally:
                    os.close(errors_in)
                theirs.close()
                try:
                    self._read(1, time.monotonic() + START_TIMEOUT)
                except SandboxError as error:
                    self.close()
                    text = complaints.read(4000).decode(errors="replace").strip()
                    explain = gvisor.explain if self.wall == "gvisor" else bubblewrap.explain
                    raise SandboxUnavailable(explain(text or str(error))) from None
                if not self.trusted:
                    self._looked = 0.0
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    def _start(self, channel: int, errors: int) -> None:
        if self.server and self.wall == "bubblewrap":
            self._process = self._forked(self.server, channel, errors)
            self._root = self._process.root
        else:
            start = {"bubblewrap": self._sealed, "gvisor": self._in_gvisor}.get(self.wall, self._trusted)
            self._process = start(channel, errors)
            self._root = psutil.Process(self._process.pid)

    def _sealed(self, channel: int, errors: int) -> subprocess.Popen:
        if os.geteuid() == 0:
            _require_readable([self.script, *self.modules])
        passed = [channel]
        try:
            files = self._opened(passed)
            boot = json.dumps([channel, f"/course/{self.script.name}", ["/course", "/site", "/work"], self.limits.resources()])
            command = ["/python/bin/python", *PYTHON_OPTIONS, "-c", BOOTSTRAP, boot]
            try:
                refused = str(bubblewrap.memory_file(seccomp.program(), passed))
                layers = bubblewrap.layers([self.script, *self.modules], files, self.limits, refused)
            except (FileNotFoundError, NotImplementedError) as error:
                raise SandboxUnavailable(f"The sandbox does not start: {error}.") from error
            for words, arguments in reversed(layers):
                command = [*words, *bubblewrap.handed_over(arguments, passed), *command]
            return subprocess.Popen(
                command, env={}, cwd="/", stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors, pass_fds=passed,
                start_new_session=True,
            )  # fmt: skip
        finally:
            for descriptor in passed[1:]:
                os.close(descriptor)

    def _in_gvisor(self, channel: int, errors: int) -> subprocess.Popen:
        self._folder = tempfile.TemporaryDirectory(prefix="gvisor-")
        opened: list[int] = []
        # the limits are set by then: gVisor counts the processes of this one sandbox
        boot = json.dumps([gvisor.CHANNEL, f"/course/{self.script.name}", ["/course", "/site", "/work"], {}])
        try:
            course, folder = [self.script, *self.modules], Path(self._folder.name)
            command = gvisor.bundle(folder, course, self._opened(opened), self.limits, PYTHON_OPTIONS, BOOTSTRAP, boot)
        except FileNotFoundError as error:
            raise SandboxUnavailable(f"The sandbox does not start: {error}.") from error
        finally:
            for descriptor in opened:
                os.close(descriptor)
        return subprocess.Popen(
            command, env={"PATH": gvisor.PATH}, cwd="/", stdin=channel, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True,
        )  # fmt: skip

    def _forked(self, server: ForkServer, channel: int, errors: int) -> Leash:
        opened: list[int] = []
        try:
            opened.append(_open_regular(self.script))
            files = self._opened(opened)
            limits, sizes = self.limits.resources(), self.limits.sizes(files.values())
            request = {"name": f"/course/{self.script.name}", "sizes": sizes, "files": list(files), "limits": limits}
            return server.fork(channel, errors, request, opened)
        except forking.Refused as error:
            raise SandboxUnavailable(str(error)) from error
        finally:
            for descriptor in opened:
                os.close(descriptor)

    def _opened(self, opened: list[int]) -> dict[str, int]:
        """Name → descriptor of each file handed in; they are added to `opened`. Raises ValueError."""
        files = {}
        for name, path in self.files.items():
            files[name] = _open_regular(path)
            opened.append(files[name])
        if sum(os.fstat(fd).st_size for fd in files.values()) > MAX_FILES_SIZE:
            raise ValueError(f"more than {MAX_FILES_SIZE // MiB} MiB of files cannot be handed to the sandbox")
        return files

    def _trusted(self, channel: int, errors: int) -> subprocess.Popen:
        self._folder = tempfile.TemporaryDirectory(prefix="trusted-")
        course, work = Path(self._folder.name, "course"), Path(self._folder.name, "work")
        for folder in (course, work):
            folder.mkdir()
        for path in (self.script, *self.modules):
            (course / path.name).symlink_to(path.resolve())
        for name, path in self.files.items():
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            with open(_open_regular(path), "rb") as source, open(work / name, "xb") as copy:
                shutil.copyfileobj(source, copy)
        boot = json.dumps([channel, str(course / self.script.name), [str(course), *site.getsitepackages(), str(work)], {}])
        return subprocess.Popen(
            [sys.executable, *PYTHON_OPTIONS, "-c", BOOTSTRAP, boot],
            env={**ENVIRONMENT, "HOME": str(work), "MPLCONFIGDIR": str(work)}, cwd=work, stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=errors, pass_fds=[channel], start_new_session=True,
        )  # fmt: skip

    def send(self, payload: bytes, timeout: float = 30.0) -> None:
        """Sends one frame; SandboxTimeout if the process does not read it within `timeout` seconds."""
        data, deadline = memoryview(len(payload).to_bytes(8, "big") + payload), time.monotonic() + timeout
        while data:
            self._tick(deadline)
            try:
                data = data[self._open_socket().send(data) :]
            except TimeoutError:
                continue
            except OSError:
                raise self._death() from None

    def receive(self, timeout: float) -> bytes:
        """The next frame; SandboxTimeout if it is not complete within `timeout` seconds."""
        deadline = time.monotonic() + timeout
        length = int.from_bytes(self._read(8, deadline), "big")
        if length > MAX_FRAME:
            raise SandboxGarbage(f"a frame of {length} bytes was announced; at most {MAX_FRAME} are allowed")
        return self._read(length, deadline)

    def _read(self, length: int, deadline: float) -> bytes:
        data = bytearray()
        while len(data) < length:
            self._tick(deadline)
            try:
                part = self._open_socket().recv(min(length - len(data), MiB))
            except TimeoutError:
                continue
            except OSError:
                part = b""
            if not part:
                raise self._death()
            data += part
        return bytes(data)

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise SandboxDied("the sandbox is closed")
        return self._socket

    def _tick(self, deadline: float) -> None:
        """Sets how long the next read or write may wait; watches the memory. Called before each, however small."""
        now = time.monotonic()
        if now >= deadline:
            raise SandboxTimeout("no complete answer in time")
        self._open_socket().settimeout(min(TICK, deadline - now))
        if now - self._looked >= TICK:
            self._looked = now
            tree, limits = self._tree(), self.limits
            memory = _memory(tree, limits.memory)
            counts = (_entries, _sockets) if self.wall == "bubblewrap" else ()  # elsewhere these are the host's
            entries, sockets = [max(map(count, tree), default=0) for count in counts] or (0, 0)
            if memory > limits.memory or entries > limits.entries or sockets > limits.sockets:
                self.close()
                used = f"{memory // MiB} MiB, {entries} files and {sockets} sockets"
                allowed = f"{limits.memory // MiB}, {limits.entries} and {limits.sockets}"
                raise SandboxDied(f"killed for its memory: {used} in use; allowed are {allowed}")

    def _tree(self) -> list[psutil.Process]:
        """All processes inside, process 1 of the namespace first. A daemon cannot leave: its parent becomes that process 1."""
        with suppress(psutil.NoSuchProcess):
            if self._root is not None:
                return self._root.children(recursive=True)
        return []

    def _death(self) -> SandboxDied:
        """Says how the process ended, now that its end of the socket is shut."""
        status = None
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                status = self._process.wait(timeout=0.5)
        if status is None:
            return SandboxDied("it closed its connection to the judge")
        number = -status if status < 0 else status - 128  # bwrap reports a signal as a shell does
        if number in set(signal.Signals):
            return SandboxDied(f"killed by {signal.Signals(number).name}")
        return SandboxDied(f"exited with status {status}")

    def close(self) -> None:
        """Ends every process inside, waits until they are gone, and releases everything. May be called again."""
        if self._process is not None:
            tree = self._tree()
            # The kernel ends a whole namespace with its process 1, and bwrap, whose child that is, reaps it and exits.
            first = tree[:1] if self.wall == "bubblewrap" else tree
            for process in first:
                with suppress(psutil.NoSuchProcess):
                    process.kill()
            if tree and not self.trusted:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(timeout=2)
            self._process.kill()
            self._process.wait()
            if isinstance(self._process, Leash):
                self._process.close()
            if not self.trusted:
                psutil.wait_procs(first, timeout=5)
            self._process = self._root = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None


def _memory(tree: Sequence[psutil.Process], enough: int) -> int:
    """Bytes of memory of all processes: at first a bound that is quick to know, and only if that is above `enough`, exactly."""

    def total(count: Callable[[psutil.Process], int]) -> int:
        used = 0
        for process in tree:
            with suppress(psutil.Error, OSError):
                used += count(process)
        return used

    bound = total(lambda process: process.memory_info().rss)
    # Pages that n processes share (forks of one that has torch loaded) count 1/n each.
    return bound if bound <= enough else total(_share)


def _share(process: psutil.Process) -> int:
    info = process.memory_full_info()
    return info.pss + info.swap


def _entries(process: psutil.Process) -> int:
    """Files and folders on the three tmpfs that a process sees (the outer layer's processes see none of them)."""
    with suppress(OSError):
        seen = [os.statvfs(f"/proc/{process.pid}/root{folder}") for folder in ("/work", "/tmp", "/dev/shm")]
        return sum(one.f_files - one.f_ffree for one in seen)
    return 0


def _sockets(process: psutil.Process) -> int:
    """Sockets in a process's network namespace; what lies in them, up to some MiB each, counts as nobody's memory."""
    with suppress(OSError):
        return int(Path(f"/proc/{process.pid}/net/sockstat").read_text().split()[2])  # "sockets: used 5 …"
    return 0


# --- does it work here? ---------------------------------------------------------------------------------------------


PROBE = """
import socket, sys
answer = "ok"
try:
    if {torch}:
        import torch
except BaseException as error:
    answer = f"{{type(error).__name__}}: {{error}}"
frame = answer.encode()
socket.socket(fileno=int(sys.argv[1])).sendall(len(frame).to_bytes(8, "big") + frame)
"""


def probe(torch: bool = False, server: ForkServer | None = None, wall: str = "bubblewrap") -> list[Problem]:
    """What keeps a real sandbox, or one that `server` forks, from working here: nothing, if the list is empty.

    `torch` also imports torch inside (seconds).
    """
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder, "probe.py")
        script.write_text(PROBE.format(torch=torch))
        script.chmod(0o644)  # where root grades, what runs inside is nobody, whatever root's umask
        try:
            with Sandbox(script, server=server, wall=wall) as sandbox:
                answer = sandbox.receive(timeout=START_TIMEOUT).decode()
        except SandboxUnavailable as error:
            return [Problem("no sandbox" if wall == "bubblewrap" else "it does not start", str(error))]
        except SandboxError as error:
            return [
                Problem(f"a program that starts inside the sandbox does not answer: {error}", "Try again; then tell the makers.")
            ]
    if answer != "ok":
        what = f"import torch fails inside the sandbox: {answer[:500]}"
        return [Problem(what, "Install requirements.txt into this environment.")]
    return []


def require(wall: str = "bubblewrap") -> None:
    """SandboxUnavailable, with one paragraph that says how to enable it, unless a sandbox starts on this machine."""
    if problems := probe(wall=wall):
        raise SandboxUnavailable(problems[0].remedy)
