"""Wait for another process that does the same work in this checkout, and say for whom."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path


@contextmanager
def one_at_a_time(path: Path) -> Iterator[None]:
    """Hold the lock `path`; the kernel gives it back when a process ends, however it ends.

    Whoever has to wait reads on stderr which process has it, since when, and with which command.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            print(f"waiting for {path.stem}: {lock.read() or 'another process'}", file=sys.stderr, flush=True)
            fcntl.flock(lock, fcntl.LOCK_EX)
        lock.truncate(0)
        command = " ".join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])
        lock.write(f"process {os.getpid()} has it since {datetime.now():%H:%M:%S} (`{command}`)")
        lock.flush()
        yield
