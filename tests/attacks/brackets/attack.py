"""Sends sixty megabytes of brackets, which would parse into gigabytes of lists in the judge's process."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, last, write, wrong

BODY = """
import os
import numpy as np
import safetensors.numpy
payload = safetensors.numpy.save({"json": np.frombuffer(b"[" + b"[]," * 20_000_000 + b"[]]", np.uint8)})
channel._socket.sendall(len(payload).to_bytes(8, "big") + payload)
os._exit(0)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    last(notebook, CHANNEL)
    write(folder, notebook)
