"""Made-up notebooks and workers' answers, led by which code they reach: atheris (libFuzzer) around what test_fuzz.py asks.

    python tools/fuzz.py [--minutes 10] [--folder test-artefacts/fuzz]

Each of the two readers gets half the time. What reached new code stays in the folder, and the next run begins with it. A sample that
breaks a promise of tests/autograder/grading/test_fuzz.py is kept there as NAME-crash-…, is printed, and makes the exit status 1;
`--only NAME --replay FILE` tries it again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("COURSE_SEED", "0")
os.environ.setdefault("OMP_NUM_THREADS", "1")

READERS = ("notebook", "worker")
INSTRUMENTED = ["autograder.grading", "course_lib.checks", "nbformat"]
SLOWEST = 20  # seconds for one sample; the judge's own limits are for larger ones
WORDS = [
    "cells", "cell_type", "code", "markdown", "raw", "source", "metadata", "nbgrader", "grade_id", "solution", "grade",
    "locked", "tags", "live", "id", "nbformat", "nbformat_minor", "worksheets", "language_info", "version",
    "observations", "uses", "missing", "ended", "loaded", "running", "outputs", "gradients", "graph", "mutated",
    "error", "message", "kind", "tensor", "@array", "a0", "a1", "line", "newer", "sets", "def", "return", "import",
    "null", "true", "NaN", "Infinity", "1e999", "\\\\ud800", "\\\\x00", "f", "g", "test_f", "why",
]  # fmt: skip


def fuzz(reader: str, arguments: list[str]) -> None:
    import atheris
    import torch  # not instrumented, nor what it brings

    with atheris.instrument_imports(include=INSTRUMENTED):
        from course_lib.checks.stored import encode
        from tests.autograder.grading import test_fuzz

    arrays = [
        torch.ones(2),
        torch.full((2,), float("nan")),
        torch.ones(0),
        torch.zeros(2, 2, dtype=torch.complex64),
        torch.tensor(True),
    ]

    def frames(data: bytes) -> list[bytes]:
        """Parts that a zero byte and a newline end: after "j" the text of a message with arrays, otherwise a frame as it stands."""
        parts = [part for part in data.split(b"\0\n")[:4] if part] or [b""]
        return [_message(part[1:], arrays) if part[:1] == b"j" else part for part in parts]

    def one(data: bytes) -> None:
        if reader == "notebook":
            test_fuzz.judge_notebook(data)
        else:
            test_fuzz.judge_worker(frames(data))

    folder = Path(arguments[-1])
    if folder.is_dir():
        valid = json.dumps(test_fuzz.VALID)
        said = [
            {"observations": [{"kind": "tensor", "outputs": {"": {"@array": "a0"}}}], "uses": ["f"]},
            {"loaded": {"1": {"line": 1}}},
        ]
        seeds = (
            [valid.encode(), valid[:200].encode()]
            if reader == "notebook"
            else [b"j" + json.dumps(text).encode() for text in said]
        )
        seeds += [] if reader == "notebook" else [encode({"missing": True}), encode({"ended": "timeout"}), encode({"running": 1})]
        for number, seed in enumerate(seeds):
            (folder / f"seed-{number}").write_bytes(seed)
    atheris.Setup([sys.argv[0], *arguments], one)
    atheris.Fuzz()


def _message(text: bytes, arrays: list) -> bytes:
    import safetensors.torch
    import torch

    whole = torch.frombuffer(bytearray(text), dtype=torch.uint8) if text else torch.zeros(0, dtype=torch.uint8)
    return safetensors.torch.save({"json": whole, **{f"a{number}": array for number, array in enumerate(arrays)}})


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--folder", type=Path, default=ROOT / "test-artefacts" / "fuzz")
    parser.add_argument("--only", choices=READERS)
    parser.add_argument("--replay", type=Path)
    given = parser.parse_args()
    readers = (given.only,) if given.only else READERS
    failed = []
    for reader in readers:
        folder = (given.folder / reader).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        words = folder.parent / "words.txt"
        words.write_text("".join(f'"{word}"\n' for word in WORDS))
        seconds = round(given.minutes * 60 / len(readers))
        options = [
            f"-max_total_time={seconds}",
            f"-timeout={SLOWEST}",
            "-rss_limit_mb=4096",
            "-max_len=8192",
            "-print_final_stats=1",
        ]
        options += [f"-dict={words}", f"-artifact_prefix={folder.parent}/{reader}-"]
        arguments = [str(given.replay)] if given.replay else [*options, str(folder)]
        command = [sys.executable, "-c", f"import sys; from tools import fuzz; fuzz.fuzz({reader!r}, sys.argv[1:])", *arguments]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))}
        done = subprocess.run(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True, errors="replace")
        told = done.stderr.splitlines()
        print(f"{reader}: " + "; ".join(line.removeprefix("stat::") for line in told if line.startswith("stat::number_of_exec")))
        if done.returncode:
            failed.append(reader)
            print("\n".join(told[-60:]))
    print(f"A promise is broken: {', '.join(failed)}." if failed else "Every sample was read or refused in words.")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
