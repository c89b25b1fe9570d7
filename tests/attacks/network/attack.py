"""Calls home: by name, by address, to the host's own loopback, and through abstract sockets."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import socket
for family, address in ((2, ("127.0.0.1", 22)), (2, ("127.0.0.1", 8888)), (2, ("1.1.1.1", 53)), (1, "\\0/tmp/.X11-unix/X0"), (1, "\\0/org/bus")):
    with socket.socket(family) as one:
        one.settimeout(0.3)
        if one.connect_ex(address) == 0:
            raise AssertionError(address)
try:
    socket.getaddrinfo("example.com", 80)
except OSError:
    pass
else:
    raise AssertionError("a name was resolved")
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
