"""Tries the doors of the sandbox: mounts, namespaces, tracing, process 1's root, writable kernel settings, device files."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import ctypes, os
libc = ctypes.CDLL(None, use_errno=True)
tries = {
    "mount": lambda: libc.mount(b"/", b"/tmp", None, 4096, None),
    "unshare": lambda: libc.unshare(0x10000000),
    "chroot": lambda: libc.chroot(b"/proc/1/root"),
    "ptrace": lambda: libc.ptrace(16, os.getppid(), None, None),
    "setns": lambda: libc.setns(os.open("/proc/1/ns/mnt", os.O_RDONLY), 0),
    "setuid": lambda: libc.setuid(0),
}
for name, attempt in tries.items():
    try:
        if attempt() == 0:
            raise AssertionError(name)
    except OSError:
        pass
for path in ("/proc/sys/kernel/core_pattern", "/proc/sysrq-trigger", "/course/worker.py", "/site/torch/__init__.py", "/python/x", "/dev/sda"):
    try:
        open(path, "ab").close()
    except OSError:
        continue
    raise AssertionError(path)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
