"""Looks for the host's files, the gradebook, other submissions and a file with a secret beside them, by every way that leads
out of a folder."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import os
secrets = ("/etc/passwd", "/etc/shadow", "/root", "/home", "/work/..", "/proc/1/root/etc/passwd", "/proc/self/root/root", "/proc/1/cwd/etc")
for path in (*secrets, "../../honest-1/ch44/ch44.ipynb", "../secret.txt", "../../secret.txt", "/proc/self/cwd/../../secret.txt"):
    if os.path.isfile(path) or path in ("/root", "/home") and os.path.exists(path):
        raise AssertionError(path)
for parent, folders, files in os.walk("/"):
    folders[:] = [one for one in folders if os.path.join(parent, one) not in ("/proc", "/site", "/python", "/usr/lib", "/sys")]
    if {"secret.txt", "ch44.ipynb", "gradebook.db", "grades.csv"} & set(files):
        raise AssertionError(parent)
for number in os.listdir("/proc/self/fd"):
    try:
        target = os.readlink(f"/proc/self/fd/{number}")
    except OSError:
        continue
    if target.startswith("/") and not target.startswith(("/dev/null", "/proc", "/site", "/python", "/work")):
        raise AssertionError(target)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
