"""The arguments of bubblewrap (bwrap): what a learner's process sees of this machine, and what it may use up.

`layers(...)` says how to call bwrap; autograder.grading.sandbox calls it. bwrap carries its arguments out in their order.
"""

import functools
import os
import shutil
import sys
import sysconfig
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

from course_lib.checks.packages import LEARNER_PACKAGES

MiB = 1 << 20
NOBODY = "65534"
APART = ("--unshare-net", "--unshare-ipc", "--unshare-uts", "--hostname", "sandbox")
LIBRARY_CACHE = ("--ro-bind-try", "/etc/ld.so.cache", "/etc/ld.so.cache")

ENVIRONMENT = {
    "HOME": "/work", "MPLBACKEND": "Agg", "MPLCONFIGDIR": "/tmp", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
    "PYTHONHASHSEED": "0", "PYTHONUTF8": "1", "TORCHDYNAMO_DISABLE": "1",  # no compiler inside: torch.compile is eager
}  # fmt: skip


@dataclass(frozen=True)
class Limits:
    """What a sandbox may use up, in bytes and counts.

    One process that has torch, matplotlib and a Gymnasium environment loaded takes 0.9 GiB of addresses and 0.3 GiB of memory.
    """

    address_space: int = 4096 * MiB  # of one process
    memory: int = 2048 * MiB  # of all processes together, in proportion where they share pages
    processes: int = 64  # and threads
    file_size: int = 64 * MiB
    open_files: int = 256
    work: int = 128 * MiB  # size of /work, beside the files put there
    tmp: int = 128 * MiB
    shm: int = 64 * MiB
    entries: int = 20_000  # files and folders in these three: each, though empty, takes 1 KiB of kernel memory
    sockets: int = 64

    def resources(self) -> dict[str, int]:
        return {
            "RLIMIT_AS": self.address_space, "RLIMIT_NPROC": self.processes, "RLIMIT_FSIZE": self.file_size,
            "RLIMIT_NOFILE": self.open_files, "RLIMIT_CORE": 0,
        }  # fmt: skip

    def sizes(self, files: Iterable[int]) -> dict[str, int]:
        """Bytes of each folder that can be written; of /work, beside the files with these descriptors."""
        given = sum(os.fstat(descriptor).st_size + 4096 for descriptor in files)
        return {"/dev/shm": self.shm, "/tmp": self.tmp, "/work": self.work + given}


def closure(requirements: Sequence[str]) -> dict[str, metadata.Distribution]:
    """The installed distributions that `requirements` (with extras) need, themselves included; name → distribution."""
    found: dict[str, metadata.Distribution] = {}
    todo, done = [Requirement(text) for text in requirements], set()
    while todo:
        need = todo.pop()
        if (need.name, frozenset(need.extras)) in done:
            continue
        done.add((need.name, frozenset(need.extras)))
        with suppress(metadata.PackageNotFoundError):
            found[need.name] = metadata.distribution(need.name)
            for requirement in map(Requirement, found[need.name].requires or ()):
                extras = {"", *need.extras}
                if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in extras):
                    todo.append(requirement)
    return found


def _top_level(distribution: metadata.Distribution) -> set[str]:
    """The first part of each path that a distribution has installed; "" of an absolute one."""
    record = distribution.read_text("RECORD")
    if record is None:
        return {file.parts[0] if not file.is_absolute() else "" for file in distribution.files or ()}
    # `distribution.files` would make an object of each of torch's ten thousand lines
    return {line.lstrip('"').partition("/")[0].partition(",")[0] for line in record.splitlines()}


@functools.cache
def packages() -> dict[str, Path]:
    """Top-level names under /site → where they are installed. An installed `solutions` or `autograder` is not among them.

    Raises: FileNotFoundError if one of LEARNER_PACKAGES is missing: its absence inside would look like a learner's mistake.
    """
    tops, found = {}, closure(LEARNER_PACKAGES)
    if missing := [name for name in LEARNER_PACKAGES if Requirement(name).name not in found]:
        raise FileNotFoundError(f"{', '.join(missing)} not installed: run `pip install -r requirements.txt`")
    for distribution in found.values():
        for top in _top_level(distribution):
            if top not in ("", "..", "__pycache__") and not top.endswith(".pth"):
                tops[top] = Path(str(distribution.locate_file(top)))
    return {top: path for top, path in sorted(tops.items()) if path.exists()}


@functools.cache
def host_mounts() -> tuple[str, ...]:
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
    arguments += _system_libraries()
    for packages_of_the_system in Path("/usr/lib").glob("python*"):
        arguments += ["--tmpfs", str(packages_of_the_system), "--remount-ro", str(packages_of_the_system)]
    return (*arguments, *LIBRARY_CACHE)


def _system_libraries() -> list[str]:
    """bwrap arguments for /usr/lib and, as on the host, the links to it (on an old system: folders) /lib and /lib64."""
    arguments = []
    for path in map(Path, ("/usr/lib", "/usr/lib64", "/lib", "/lib64")):
        if path.is_symlink():
            arguments += ["--symlink", os.readlink(path), str(path)]
        elif path.is_dir():
            arguments += ["--ro-bind", str(path), str(path)]
    return arguments


def layers(course: Sequence[Path], files: Mapping[str, int], limits: Limits, filter_fd: str) -> list[tuple[list[str], list[str]]]:
    """The calls of bwrap, outermost first: (words of the command, arguments for its --args).

    The kernel exempts root from RLIMIT_NPROC even in a user namespace, so learner code must run as somebody else; but an
    interpreter under /root can only be reached by root. So for root there are two layers: root mounts, setpriv becomes nobody,
    and nobody builds the real sandbox. For an ordinary user there is the second only.

    Args:
      course: host paths to appear in /course.
      files: name in /work → descriptor of its contents.
      filter_fd: descriptor of the seccomp program.
    Raises: FileNotFoundError if a program is missing; the text says how to install it.
    """
    mounts = list(host_mounts())
    for path in course:
        mounts += ["--ro-bind", str(path.resolve()), f"/course/{path.name}"]
    sealed = [*_sealed(limits, files), "--seccomp", filter_fd]
    if os.geteuid() != 0:
        return [([tool("bwrap")], [*APART, *mounts, *sealed])]
    again = [word for path in ("/python", "/site", "/course") for word in ("--ro-bind", path, path)]
    become_nobody = ["/tools/setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--inh-caps=-all"]
    tools = ["--dir", "/tools", *(word for name in ("bwrap", "setpriv") for word in ("--ro-bind", tool(name), f"/tools/{name}"))]
    return [
        ([tool("bwrap")], [*_outer([*tools, *mounts]), "--die-with-parent"]),
        ([*become_nobody, "/tools/bwrap"], [*again, *_system_libraries(), *LIBRARY_CACHE, *sealed]),
    ]


def around_server(course: Sequence[Path]) -> tuple[list[str], list[str]]:
    """The call of bwrap (words of the command, arguments for its --args) around the process that forks one for each submission.

    It sees what they may see; they seal themselves. It ends when the judge's end of its socket is shut, whichever thread started it,
    and where root starts it, it becomes nobody itself.
    """
    mounts = list(host_mounts())
    for path in course:
        mounts += ["--ro-bind", str(path.resolve()), f"/course/{path.name}"]
    ending = ["--perms", "1777", "--tmpfs", "/tmp", "--dir", "/work", "--chdir", "/"]
    ending += [*_environment(), "--remount-ro", "/dev", "--remount-ro", "/"]
    if os.geteuid() == 0:
        return [tool("bwrap")], [*_outer(mounts), *ending]
    apart = ["--unshare-user", "--unshare-pid", *APART, "--uid", NOBODY, "--gid", NOBODY, "--cap-drop", "ALL", "--new-session"]
    return [tool("bwrap")], [*apart, "--clearenv", "--proc", "/proc", "--dev", "/dev", *mounts, *ending]


def _outer(mounts: Sequence[str]) -> list[str]:
    """Root's layer; only what `mounts` says is carried into the inner one."""
    arguments = ["--unshare-pid", *APART, "--new-session"]
    # The kernel grants a new /proc (the inner layer's) only to those who see a whole one already: hence the bind.
    arguments += ["--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID", "--bind", "/proc", "/proc", "--dev", "/dev"]
    # A folder that bwrap makes unasked is for its owner, root, only.
    for folder in ("/usr", "/etc", "/python", "/python/bin", "/python/lib", "/site", "/course", "/tmp"):
        arguments += ["--dir", folder]
    return [*arguments, *mounts]


def _sealed(limits: Limits, files: Mapping[str, int]) -> list[str]:
    """The layer around the learner: namespaces, a /proc, /dev, /work and /tmp of its own, and no way up."""
    arguments = ["--unshare-user", "--disable-userns", "--unshare-pid", "--uid", NOBODY, "--gid", NOBODY, "--cap-drop", "ALL"]
    arguments += ["--die-with-parent", "--new-session", "--clearenv", "--proc", "/proc", "--dev", "/dev"]
    for folder, size in limits.sizes(files.values()).items():
        arguments += ["--size", str(size), "--tmpfs", folder]
    for name, fd in files.items():
        arguments += ["--perms", "0444", "--file", str(fd), f"/work/{name}"]
    return [*arguments, *_environment(), "--remount-ro", "/dev", "--remount-ro", "/", "--chdir", "/work"]


def _environment() -> list[str]:
    return [word for pair in {**ENVIRONMENT, "LD_LIBRARY_PATH": "/python/lib"}.items() for word in ("--setenv", *pair)]


def handed_over(arguments: Sequence[str], passed: list[int]) -> list[str]:
    """The words that tell bwrap where to read `arguments`: process 1 inside shows its own to learners. Adds a descriptor to `passed`."""
    if not arguments:
        return []
    return ["--args", str(memory_file(b"".join(os.fsencode(argument) + b"\0" for argument in arguments), passed)), "--"]


def memory_file(data: bytes, passed: list[int]) -> int:
    """A descriptor, added to `passed`, from which a child reads `data`."""
    descriptor = os.memfd_create("sandbox")
    passed.append(descriptor)
    os.write(descriptor, data)
    os.lseek(descriptor, 0, os.SEEK_SET)
    return descriptor


def tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        package = {"bwrap": "bubblewrap", "setpriv": "util-linux"}[name]
        raise FileNotFoundError(f"{name} is missing: install {package} (`sudo apt install {package}`)")
    return path


def explain(complaint: str) -> str:
    """What bubblewrap said, in one paragraph with what can be done about it."""
    return f"The sandbox does not start: {complaint[:500]}. {_remedy(complaint)}"


def _remedy(complaint: str) -> str:
    if "apparmor_restrict_unprivileged_userns" in complaint or _kernel("kernel/apparmor_restrict_unprivileged_userns") == "1":
        return (
            "Ubuntu's AppArmor restricts user namespaces: run `sudo sysctl kernel.apparmor_restrict_unprivileged_userns=0`, "
            "or give /usr/bin/bwrap an AppArmor profile that allows them (`flags=(unconfined) { userns, }`)."
        )
    if _kernel("kernel/unprivileged_userns_clone") == "0":
        return "User namespaces are switched off: run `sudo sysctl kernel.unprivileged_userns_clone=1`."
    if _kernel("user/max_user_namespaces") == "0":
        return "User namespaces are switched off: run `sudo sysctl user.max_user_namespaces=15000`."
    if "mount proc" in complaint:
        return "A container hides parts of /proc: start it with `--security-opt systempaths=unconfined`, or grade outside it."
    if "usage:" in complaint or "Unknown option" in complaint:
        return "bubblewrap 0.8 or newer is needed (bwrap --version); Debian 12 and Ubuntu 24.04 have it."
    if "/python" in complaint or "libpython" in complaint:
        return f"Ordinary users must be able to read the interpreter under {sys.base_prefix} and the packages beside it."
    return (
        "Unprivileged user namespaces must be allowed (in a container: `--security-opt seccomp=unconfined --security-opt "
        "apparmor=unconfined`); `bwrap --unshare-user --ro-bind / / true` shows whether they are."
    )


def _kernel(name: str) -> str:
    with suppress(OSError):
        return Path("/proc/sys", name).read_text().strip()
    return ""
