"""What each process of a pool does first."""

from __future__ import annotations

import os
from multiprocessing import parent_process
from threading import Thread


def begin() -> None:
    """In a new process, before torch is loaded: one thread, and an end when its parent ends."""
    os.environ["OMP_NUM_THREADS"] = "1"
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A process whose parent was killed would go on, and wait for ever."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
