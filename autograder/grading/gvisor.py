"""The stronger wall: gVisor (`runsc`), a kernel of its own, in user space, between a learner's code and this machine's.

Bubblewrap leaves learners the host's kernel, less what its namespaces and the filter of system calls hide. Inside gVisor a system call
is answered by another program, itself shut in, which asks the host for little; a mistake in the host's kernel is then two walls away. It
costs some seconds for each submission, as nothing is forked from a process that has torch loaded.

`bundle(...)` lays out what runsc reads, with the same folders, limits and users as bubblewrap's, and says how to call it;
autograder.grading.sandbox does. The judge's socket comes in as standard input, the one descriptor that every version of runsc hands on.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from autograder.grading import bubblewrap
from autograder.grading.bubblewrap import ENVIRONMENT, NOBODY, Limits

HANDED_IN = "/handed"  # where files lie until they are copied to /work
CHANNEL = 3
OWNED = (f"uid={NOBODY}", f"gid={NOBODY}")
PATH = "/usr/sbin:/usr/bin:/sbin:/bin"  # for runsc, which gets no other environment

# Before what every sandbox runs first: the socket gets its number, /work its files.
BEGINNING = f"""
import os, shutil
os.dup2(0, {CHANNEL})
shutil.copytree("{HANDED_IN}", "/work", dirs_exist_ok=True)
"""


def missing() -> str:
    """What keeps runsc from being called here, and what would mend it; "" if nothing does."""
    if shutil.which("runsc") is None:
        return "runsc is missing: install gVisor (`sudo apt install runsc`, or see https://gvisor.dev/docs/user_guide/install/)"
    return ""


def bundle(
    folder: Path, course: Sequence[Path], files: Mapping[str, int], limits: Limits, words: Sequence[str], begin: str, boot: str
) -> list[str]:
    """Lay out an OCI bundle in `folder`; the command that runs it.

    Args:
      folder: empty, and the caller's to remove.
      course: host paths to appear in /course.
      files: name in /work → descriptor of its contents.
      words, begin, boot: Python's options, the program to run first inside, and its one argument.
    Raises: FileNotFoundError if runsc or setpriv is missing; the text says how to install it.
    """
    if problem := missing():
        raise FileNotFoundError(problem)
    root, handed = folder / "rootfs", folder / "handed"
    for place in ("proc", "dev", "work", "tmp", "course", HANDED_IN[1:]):
        (root / place).mkdir(parents=True)
    _copy(files, handed)
    mounts = [
        {"destination": "/proc", "type": "proc", "source": "proc"},
        {"destination": "/dev", "type": "dev", "source": "dev"},
    ]
    for place, size in limits.sizes(files.values()).items():
        mounts.append(_mount(place, "tmpfs", "tmpfs", "nosuid", "nodev", f"size={size}", "mode=0755", *OWNED))
    for kind, source, target in _host_mounts():
        if kind == "link":
            (root / target[1:]).symlink_to(source)
        elif kind == "empty":
            mounts.append(_mount(target, "tmpfs", "tmpfs", "ro"))
        else:
            mounts.append(_bind(root, source, target))
    mounts += [_bind(root, str(path.resolve()), f"/course/{path.name}") for path in course]
    mounts.append(_bind(root, str(handed), HANDED_IN))
    config = {
        "ociVersion": "1.0.2",
        "hostname": "sandbox",
        "root": {"path": str(root), "readonly": True},
        "mounts": mounts,
        "process": {
            "user": {"uid": int(NOBODY), "gid": int(NOBODY)},
            "args": ["/python/bin/python", *words, "-c", BEGINNING + begin, boot],
            "env": [f"{name}={value}" for name, value in {**ENVIRONMENT, "LD_LIBRARY_PATH": "/python/lib"}.items()],
            "cwd": "/work",
            "capabilities": {},
            "noNewPrivileges": True,
            "oomScoreAdj": 1000,
            "rlimits": [{"type": name, "hard": value, "soft": value} for name, value in limits.resources().items()],
        },
        "linux": {"namespaces": [{"type": one} for one in ("pid", "ipc", "uts", "mount", "network")]},
    }
    (folder / "config.json").write_text(json.dumps(config))
    # runsc takes everything with it when it ends, and setpriv ends it with the thread that has started it
    command = [bubblewrap.tool("setpriv"), "--pdeathsig", "KILL", str(shutil.which("runsc"))]
    command += [] if os.geteuid() == 0 else ["--rootless"]
    command += ["--ignore-cgroups", "--network=none", "--root", str(folder / "state")]
    return [*command, "run", "--bundle", str(folder), folder.name]  # its name must be the only one on the machine


def explain(complaint: str) -> str:
    """What runsc said, in one paragraph with what can be done about it."""
    advice = "`runsc --rootless --network=none do true` shows whether it works here at all; `--wall bubblewrap` does without it."
    return f"gVisor does not start: {complaint[:500]}. {advice}"


def _mount(target: str, kind: str, source: str, *options: str) -> dict[str, Any]:
    return {"destination": target, "type": kind, "source": source, "options": list(options)}


def _bind(root: Path, source: str, target: str) -> dict[str, Any]:
    """Read-only; with a place to mount it, which runsc must not have to make."""
    place = root / target[1:]
    if os.path.isdir(source):
        place.mkdir(parents=True, exist_ok=True)
    else:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.touch()
    return _mount(target, "bind", source, "ro", "rbind")


def _host_mounts() -> Iterator[tuple[str, str, str]]:
    """What bubblewrap mounts of the host, as (kind, source, target)."""
    words = iter(bubblewrap.host_mounts())
    for word in words:
        if word == "--remount-ro":
            next(words)
        elif word == "--tmpfs":
            yield "empty", "", next(words)
        else:
            kind = {"--ro-bind": "bind", "--ro-bind-try": "bind", "--symlink": "link"}[word]
            source, target = next(words), next(words)
            if word != "--ro-bind-try" or os.path.exists(source):
                yield kind, source, target


def _copy(files: Mapping[str, int], folder: Path) -> None:
    """Readable for whoever nobody is."""
    folder.mkdir()
    for name, descriptor in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with open(target, "xb") as copy, open(descriptor, "rb", closefd=False) as source:
            shutil.copyfileobj(source, copy)
        target.chmod(0o444)
    for place in (folder, *folder.rglob("*")):
        if place.is_dir():
            place.chmod(0o755)


def around(kernel: Path = Path("/proc/cmdline"), root: Path = Path("/")) -> str:
    """Which container, or gVisor, this process itself runs in; "" if it sees none."""
    with suppress(OSError):
        if "gvisor" in kernel.read_text():  # the kernel that it says it has booted
            return "gVisor"
    for mark, name in (("run/.containerenv", "a podman container"), (".dockerenv", "a docker container")):
        if (root / mark).exists():
            return name
    return ""
