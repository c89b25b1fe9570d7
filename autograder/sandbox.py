"""A Python process that cannot see or touch anything but what it is given: bubblewrap around a learner's code.

    with Sandbox(script, modules=[course_lib], files={"policy.pt": path}) as sandbox:
        sandbox.send(request)
        answer = sandbox.receive(timeout=60)

Inside, `script` runs as `/course/<name>` with `sys.argv[1]` the number of a stream socket to the judge; a frame is its length
(8 bytes, big-endian) and that many bytes. It sees the interpreter (/python), the packages of `LEARNER_PACKAGES` with what
they need (/site), `modules` (/course, read-only), `files` in its working directory (/work, a small tmpfs), the system's
libraries, and nothing else of the host: no network, no other process, no environment. Standard streams are /dev/null, for what a
learner prints in a CI log could be a workflow command. `sys.path` is the standard library, /course, /site, /work: files handed in can be
imported but shadow nothing.

Whatever fails before `script` starts is ours (`SandboxUnavailable`); whatever fails later is the learner's: `SandboxTimeout`,
`SandboxDied`, `SandboxGarbage`. After any of them the sandbox is of no use; close it.

Use a Sandbox in the thread that opened it: bubblewrap's --die-with-parent follows that thread, not the process.
"""

import functools
import json
import os
import shutil
import signal
import site
import socket
import stat
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path, PurePosixPath

import psutil
from packaging.requirements import Requirement

from autograder import seccomp

MiB = 1 << 20
MAX_FRAME = 64 * MiB
MAX_FILES = 200  # each is an open descriptor of ours while the sandbox starts
START_TIMEOUT = 60.0  # seconds until the interpreter runs; only an overloaded machine needs more than 0.2
TICK = 0.2  # seconds between two looks at the memory
NOBODY = "65534"

# What a learner may import, beside course_lib. Their requirements come with them; nothing else that is installed does.
LEARNER_PACKAGES = ("torch", "numpy", "matplotlib", "ipywidgets", "gymnasium[box2d,mujoco]", "safetensors", "tqdm")

ENVIRONMENT = {
    "HOME": "/work", "MPLBACKEND": "Agg", "MPLCONFIGDIR": "/tmp", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
    "PYTHONHASHSEED": "0", "PYTHONUTF8": "1",
}  # fmt: skip

# Runs first inside. `-c` rather than a file: one mount less. Limits are set here, not outside, because RLIMIT_NPROC counts per user
# namespace and would count strangers there. The one byte tells the judge that all that is ours has worked.
BOOTSTRAP = """
import json, os, resource, runpy, sys
fd, script, path, limits = json.loads(sys.argv[1])
for name, value in limits.items():
    resource.setrlimit(getattr(resource, name), (value, value))
if limits:
    with open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")
os.closerange(3, fd)
os.closerange(fd + 1, 4096)
sys.path += path
sys.argv = [script, str(fd)]
os.write(fd, b"+")
for standard in (0, 1, 2):
    os.dup2(os.open(os.devnull, os.O_RDWR), standard)
os.closerange(3, fd)
os.closerange(fd + 1, 4096)
del json, resource, name, value, limits, path, standard, file
runpy.run_path(script, run_name="__main__")
"""


@dataclass(frozen=True)
class Limits:
    """Bytes, and counts. One process that has torch and matplotlib loaded takes 0.9 GiB of addresses, 0.2 GiB of private memory."""

    address_space: int = 4096 * MiB  # of one process
    memory: int = 3072 * MiB  # of all processes together, in proportion where they share pages
    processes: int = 64  # and threads
    file_size: int = 64 * MiB
    open_files: int = 256
    work: int = 128 * MiB  # size of /work, beside the files put there
    tmp: int = 128 * MiB
    shm: int = 64 * MiB

    def resources(self) -> dict[str, int]:
        return {
            "RLIMIT_AS": self.address_space, "RLIMIT_NPROC": self.processes, "RLIMIT_FSIZE": self.file_size,
            "RLIMIT_NOFILE": self.open_files, "RLIMIT_CORE": 0,
        }  # fmt: skip


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


# --- what is mounted ------------------------------------------------------------------------------------------------


def closure(requirements: Sequence[str]) -> dict[str, metadata.Distribution]:
    """The installed distributions that `requirements` (with extras) need, themselves included; name → distribution."""
    found: dict[str, metadata.Distribution] = {}
    todo, done = [Requirement(text) for text in requirements], set()
    while todo:
        need = todo.pop()
        if (need.name, frozenset(need.extras)) in done:
            continue
        done.add((need.name, frozenset(need.extras)))
        with suppress(metadata.PackageNotFoundError):  # doctor tells of what is missing
            found[need.name] = metadata.distribution(need.name)
            for requirement in map(Requirement, found[need.name].requires or ()):
                extras = {"", *need.extras}
                if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in extras):
                    todo.append(requirement)
    return found


@functools.cache
def packages() -> dict[str, Path]:
    """Top-level names under /site → where they are installed. An installed `solutions` or `autograder` is not among them."""
    tops = {}
    for distribution in closure(LEARNER_PACKAGES).values():
        for file in distribution.files or ():
            top = file.parts[0]
            if top not in ("..", "/", "__pycache__") and not top.endswith(".pth"):
                tops[top] = Path(str(distribution.locate_file(top)))
    return {top: path for top, path in sorted(tops.items()) if path.exists()}


@functools.cache
def _host_mounts() -> tuple[str, ...]:
    """bwrap arguments: the interpreter, the packages and the system's libraries, read-only, at neutral paths."""
    base = Path(sys.base_prefix)
    library = Path("lib") / f"python{sys.version_info.major}.{sys.version_info.minor}"
    executable = Path(getattr(sys, "_base_executable", sys.executable)).resolve()
    mounts = [(executable, "/python/bin/python")]
    # A system interpreter shares its prefix with all other programs: take its standard library only.
    mounts += [(base / library, f"/python/{library}")] if base == Path("/usr") else [(base / "lib", "/python/lib")]
    dynamic = Path(sysconfig.get_path("platstdlib", vars={"platbase": str(base)}))
    if dynamic.is_relative_to(base / "lib64"):  # Fedora
        mounts.append((dynamic, f"/python/{dynamic.relative_to(base)}"))
    arguments = [word for source, target in mounts for word in ("--ro-bind", str(source), target)]
    for hidden in ("site-packages", "dist-packages"):
        if (base / library / hidden).is_dir():
            arguments += ["--tmpfs", f"/python/{library}/{hidden}", "--remount-ro", f"/python/{library}/{hidden}"]
    for top, path in packages().items():
        arguments += ["--ro-bind", str(path), f"/site/{top}"]
    return (*arguments, *_system_libraries(), "--ro-bind-try", "/etc/ld.so.cache", "/etc/ld.so.cache")


def _system_libraries() -> list[str]:
    """bwrap arguments for /usr/lib and, as on the host, the links to it (on an old system: folders) /lib and /lib64."""
    arguments = []
    for path in map(Path, ("/usr/lib", "/usr/lib64", "/lib", "/lib64")):
        if path.is_symlink():
            arguments += ["--symlink", os.readlink(path), str(path)]
        elif path.is_dir():
            arguments += ["--ro-bind", str(path), str(path)]
    return arguments


def _as_nobody(mounts: Sequence[str], inner: int) -> tuple[list[str], list[str], list[str]]:
    """The two layers that root needs: (arguments of the outer bwrap, mounts of the inner one, the outer's command).

    The kernel exempts root from RLIMIT_NPROC even in a user namespace, so learner code must run as somebody else; but an interpreter
    under /root can only be reached by root. So root mounts, then setpriv becomes nobody, who builds the real sandbox.
    """
    tools = [word for tool in ("bwrap", "setpriv") for word in ("--ro-bind", _tool(tool), f"/tools/{tool}")]
    outer = ["--unshare-pid", "--unshare-net", "--unshare-ipc", "--unshare-uts", "--die-with-parent", "--new-session", "--clearenv"]
    # Folders that bwrap makes by itself are for their owner only.
    for folder in ("/usr", "/etc", "/python", "/python/bin", "/python/lib", "/site", "/course", "/tools", "/tmp"):
        outer += ["--dir", folder]
    outer += ["--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID", *mounts, *tools, "--bind", "/proc", "/proc", "--dev", "/dev"]
    command = ["/tools/setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--inh-caps=-all"]
    again = [word for path in ("/python", "/site", "/course") for word in ("--ro-bind", path, path)]
    again += [*_system_libraries(), "--ro-bind-try", "/etc/ld.so.cache", "/etc/ld.so.cache"]
    return outer, again, [*command, "/tools/bwrap", "--args", str(inner), "--"]


def _sealed(limits: Limits, files: Mapping[str, int], total: int) -> list[str]:
    """bwrap arguments of the layer around the learner: namespaces, private /proc, /dev, /work and /tmp, and no way up."""
    arguments = ["--unshare-user", "--disable-userns", "--unshare-pid", "--uid", NOBODY, "--gid", NOBODY, "--cap-drop", "ALL"]
    arguments += ["--die-with-parent", "--new-session", "--clearenv", "--proc", "/proc", "--dev", "/dev"]
    sizes = {"/dev/shm": limits.shm, "/tmp": limits.tmp, "/work": limits.work + total}
    for folder, size in sizes.items():
        arguments += ["--size", str(size), "--tmpfs", folder]
    for name, fd in files.items():
        arguments += ["--perms", "0444", "--file", str(fd), f"/work/{name}"]
    for key, value in {**ENVIRONMENT, "LD_LIBRARY_PATH": "/python/lib"}.items():
        arguments += ["--setenv", key, value]
    return [*arguments, "--remount-ro", "/dev", "--remount-ro", "/", "--chdir", "/work"]


def _tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        package = {"bwrap": "bubblewrap", "setpriv": "util-linux"}[name]
        raise SandboxUnavailable(f"{name} is not installed. Install the system package {package} (apt install {package}).")
    return path


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


# --- the process ----------------------------------------------------------------------------------------------------


class Sandbox:
    """One process in its own sandbox; use it as a context manager.

    Args:
      script: the program, a host file; runs as /course/<its name>.
      modules: files and folders that appear as /course/<their name>.
      files: name relative to /work → regular file of the host (copied when the sandbox starts; at most MAX_FILES).
      limits: see Limits.
      trusted: run one's own code in an ordinary subprocess instead. Nothing is confined and no limit holds.

    Raises: SandboxUnavailable on entering; ValueError for a file or a name that intake should have refused.
    """

    def __init__(
        self,
        script: Path,
        modules: Sequence[Path] = (),
        files: Mapping[str, Path] | None = None,
        limits: Limits = Limits(),  # noqa: B008 (frozen)
        trusted: bool = False,
    ) -> None:
        self.script, self.modules, self.files = Path(script), [Path(module) for module in modules], dict(files or {})
        self.limits, self.trusted = limits, trusted
        for name in self.files:
            parts = PurePosixPath(name).parts
            if not parts or name.startswith("/") or ".." in parts or "\0" in name or str(PurePosixPath(name)) != name:
                raise ValueError(f"not a plain relative name: {name!r}")
        if len(self.files) > MAX_FILES:
            raise ValueError(f"{len(self.files)} files; at most {MAX_FILES} can be handed to the sandbox")
        self._process: subprocess.Popen | None = None
        self._socket: socket.socket | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        self._looked = 0.0

    def __enter__(self) -> "Sandbox":
        self._socket, theirs = socket.socketpair()
        errors, errors_in = os.pipe()
        # bwrap's complaints go to a pipe that nobody reads once the learner runs: /proc/1/fd/2 inside then leads nowhere.
        try:
            with theirs, os.fdopen(errors, "rb") as complaints:
                try:
                    start = self._start_trusted if self.trusted else self._start_sealed
                    start(theirs.fileno(), errors_in)
                finally:
                    os.close(errors_in)
                theirs.close()
                try:
                    self._read(1, time.monotonic() + START_TIMEOUT)
                except SandboxError as error:
                    self.close()
                    text = complaints.read(4000).decode(errors="replace").strip()
                    raise SandboxUnavailable(_explain(text or str(error))) from None
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    def _start_sealed(self, channel: int, errors: int) -> None:
        with ExitStack() as stack:

            def memory_file(data: bytes) -> int:
                fd = os.memfd_create("sandbox")
                stack.callback(os.close, fd)
                os.write(fd, data)
                os.lseek(fd, 0, os.SEEK_SET)
                fds.append(fd)
                return fd

            fds = [channel]
            files = {}
            for name, path in self.files.items():
                files[name] = _open_regular(path)
                stack.callback(os.close, files[name])
            total = sum(os.fstat(fd).st_size + 4096 for fd in files.values())
            fds += files.values()
            mounts = list(_host_mounts())
            for path in (self.script, *self.modules):
                mounts += ["--ro-bind", str(path.resolve()), f"/course/{path.name}"]
            try:
                filter_fd = memory_file(seccomp.program())
            except OSError as error:
                raise SandboxUnavailable(str(error)) from error
            boot = json.dumps([channel, f"/course/{self.script.name}", ["/course", "/site", "/work"], self.limits.resources()])
            command = ["/python/bin/python", "-P", "-s", "-S", "-B", "-c", BOOTSTRAP, boot]
            sealed = [*_sealed(self.limits, files, total), "--seccomp", str(filter_fd)]
            if os.geteuid() == 0:
                inner = memory_file(b"")
                arguments, mounts, become_nobody = _as_nobody(mounts, inner)
                command = [*become_nobody, *command]
                os.write(inner, _joined([*mounts, *sealed]))
                os.lseek(inner, 0, os.SEEK_SET)
            else:
                arguments = ["--unshare-net", "--unshare-ipc", "--unshare-uts", *mounts, *sealed]
            # bwrap is process 1 inside: with arguments and an environment of its own it would show them to the learner.
            self._process = subprocess.Popen(
                [_tool("bwrap"), "--args", str(memory_file(_joined(arguments))), "--", *command],
                env={}, cwd="/", stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors, pass_fds=fds,
                start_new_session=True,
            )  # fmt: skip

    def _start_trusted(self, channel: int, errors: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="trusted-")
        course, work = Path(self._folder.name, "course"), Path(self._folder.name, "work")
        course.mkdir(), work.mkdir()
        for path in (self.script, *self.modules):
            (course / path.name).symlink_to(path.resolve())
        for name, path in self.files.items():
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, work / name)
        boot = json.dumps([channel, str(course / self.script.name), [str(course), *site.getsitepackages(), str(work)], {}])
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-s", "-S", "-B", "-c", BOOTSTRAP, boot],
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
        if not self.trusted and now - self._looked >= TICK:
            self._looked = now
            used = sum(map(_memory, self._tree()))
            if used > self.limits.memory:
                self.close()
                raise SandboxDied(f"killed: its processes used {used // MiB} MiB of memory; {self.limits.memory // MiB} are allowed")

    def _tree(self) -> list[psutil.Process]:
        """All processes inside, process 1 of the namespace first. A daemon cannot leave: its parent becomes that process 1."""
        with suppress(psutil.NoSuchProcess):
            if self._process is not None:
                return psutil.Process(self._process.pid).children(recursive=True)
        return []

    def _death(self) -> SandboxDied:
        """Says how the process ended, now that its end of the socket is shut."""
        status = None
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                status = self._process.wait(timeout=1)
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
            for process in tree[:1] if not self.trusted else tree:
                with suppress(psutil.NoSuchProcess):
                    process.kill()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=2 if tree and not self.trusted else 0)
            self._process.kill()
            self._process.wait()
            psutil.wait_procs(tree[:1], timeout=5)
            self._process = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None


def _joined(arguments: Sequence[str]) -> bytes:
    return b"".join(os.fsencode(argument) + b"\0" for argument in arguments)


def _memory(process: psutil.Process) -> int:
    """Bytes of memory of one process; pages shared by n processes (forks of one that has torch loaded) count 1/n."""
    with suppress(psutil.Error, OSError):
        return process.memory_full_info().pss
    return 0


def _explain(text):
    return text
