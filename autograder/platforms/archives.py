"""The files of a download, whether a folder or a zip: names are made safe here, sizes are limited, links and special files are left alone.

Whoever handed something in may have chosen every byte of it. So nothing is unpacked in bulk: a file is a name and a way to read it, and
what is read is counted while it is copied, whatever the archive says about its size.
"""

from __future__ import annotations

import os
import stat
import struct
import tempfile
import unicodedata
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from autograder.grading import archives as learners_archives
from autograder.grading import intake
from autograder.grading.names import is_junk
from autograder.grading.verdicts import clean_text

MAX_FILE = 256 << 20  # bytes of one file
MAX_ENTRIES = 100_000  # files and folders of one download
MAX_DIRECTORY = 64 << 20  # bytes of a zip's table of contents, which is read whole
MAX_DEPTH = 20
MAX_TOLD = 20  # refusals of one archive that get a line each
BOMB_BYTES, BOMB_RATIO = 16 << 20, 200  # a larger file that shrinks to less than this share is one of nothing but repetition
CHUNK = 1 << 20
REPOSITORY = ".git"  # the one hidden name that tells something


class Refused(ValueError):
    """A file or an archive that is not read; the message goes on from its name."""


@dataclass(frozen=True)
class Entry:
    """One file of a download: its path with "/" between the parts, its size as far as known, and a way to read it.

    `given` is its path in the download, where `path` is another.
    """

    path: str
    size: int
    open: Callable[[], IO[bytes]]
    given: str = ""

    @property
    def name(self) -> str:
        return self.path.rpartition("/")[2]

    @property
    def parts(self) -> tuple[str, ...]:
        return tuple(self.path.split("/"))

    def under(self, prefix: str) -> Entry:
        """The same file, named from the folder `prefix` on."""
        return self.renamed(self.path.removeprefix(prefix))

    def renamed(self, path: str) -> Entry:
        """The same file under another path."""
        return Entry(path, self.size, self.open, self.shown)

    @property
    def shown(self) -> str:
        """The path by which whoever has the download finds the file."""
        return self.given or self.path


def read(entry: Entry, limit: int = MAX_FILE) -> bytes:
    """The content. Raises: Refused if it is longer than `limit`, or cannot be read."""
    return b"".join(chunks(entry, limit))


def chunks(entry: Entry, limit: int = MAX_FILE) -> Iterator[bytes]:
    """The content, piece by piece. Raises: Refused as soon as there is more of it than `limit`."""
    try:
        total = 0
        with entry.open() as stream:
            while piece := stream.read(CHUNK):
                total += len(piece)
                if total > limit:
                    raise Refused(f"is larger than {limit >> 20} MB")
                yield piece
    except (OSError, zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, ValueError, struct.error) as error:
        if isinstance(error, Refused):
            raise
        raise Refused(f"can't be read ({error})") from None
    except Exception as error:  # zlib and lzma have errors of their own
        raise Refused(f"can't be unpacked ({type(error).__name__})") from None


def entries(
    download: Path, stack: ExitStack, problems: list[str], named: Callable[[str], bool] = lambda name: False
) -> list[Entry]:
    """The files of a folder or zip, sorted by path; a line in `problems` for each that is not taken.

    What is hidden, or left by systems and editors, is passed over in silence, unless it is `named` as a platform names what a person
    has handed in.

    Raises: Refused if there is no such download, or it is neither.
    """
    if download.is_dir():
        found = list(_of_folder(download, problems, named))
    elif download.is_file():
        found = of_zip(_opener(download), download.name, stack, problems, named=named)
    else:
        raise Refused("is neither a folder nor a zip: give what the platform let you download")
    return sorted(found, key=lambda entry: entry.path)


def _of_folder(folder: Path, problems: list[str], named: Callable[[str], bool]) -> Iterator[Entry]:
    waiting, seen = [""], 0
    while waiting:
        parent = waiting.pop()
        try:
            with os.scandir(folder / parent) as scan:
                inside = sorted(scan, key=lambda entry: entry.name)
        except OSError as error:
            problems.append(f"{_shown(parent)}: can't be read ({error.strerror})")
            continue
        beside = {entry.name for entry in inside}
        for entry in inside:
            seen += 1
            if seen > MAX_ENTRIES:
                problems.append(f"{_shown(folder.name)}: only the first {MAX_ENTRIES} files and folders were looked at")
                return
            path = f"{parent}/{entry.name}" if parent else entry.name
            if entry.name == REPOSITORY:
                yield Entry(f"{path}/HEAD", 0, _opener(Path(os.devnull)))
            if _is_nobodys(entry.name, named, beside.__contains__):
                continue
            if entry.is_dir(follow_symlinks=False):
                if path.count("/") < MAX_DEPTH:
                    waiting.append(path)
                else:
                    problems.append(f"{_shown(path)}: lies more than {MAX_DEPTH} folders deep")
            elif not stat.S_ISREG(entry.stat(follow_symlinks=False).st_mode):
                problems.append(f"{_shown(path)}: is a link or a special file, which is not followed")
            elif entry.name != _clean(entry.name):
                problems.append(f"{_shown(path)}: has a name that can't be written down; rename it")
            else:
                size = entry.stat(follow_symlinks=False).st_size
                yield Entry(unicodedata.normalize("NFC", path), size, _opener(folder / path))


def _opener(path: Path) -> Callable[[], IO[bytes]]:
    def opened() -> IO[bytes]:
        return os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")

    return opened


def of_zip(
    opened: Callable[[], IO[bytes]],
    name: str,
    stack: ExitStack,
    problems: list[str],
    opener: Callable[[zipfile.ZipInfo], Callable[[], IO[bytes]]] | None = None,
    named: Callable[[str], bool] = lambda name: False,
) -> list[Entry]:
    """The files of a zip that lies in a seekable stream, which `stack` keeps open, unless there is an `opener` of its members.

    Raises: Refused.
    """
    stream = stack.enter_context(opened())
    _check_directory(stream)
    try:
        archive = stack.enter_context(zipfile.ZipFile(stream))
        members = archive.infolist()
    except Exception as error:  # a damaged directory may break it in any way
        raise Refused(f"is no zip that can be read ({error})") from None
    found: dict[str, Entry] = {}
    names = {member.filename for member in members}
    told = 0
    for member in members:
        try:
            path = _safe_path(member.filename, named, names)
            if member.is_dir() or path is None:
                continue
            _check_member(member)
        except Refused as reason:
            told += 1
            if told <= MAX_TOLD:
                problems.append(f"{_shown(name)}: {_shown(member.filename)} {reason}")
            continue
        if path in found:
            problems.append(f"{_shown(name)}: {_shown(path)} is in it twice; the last one counts")
        found[path] = Entry(path, member.file_size, opener(member) if opener else _member_opener(archive, member))
    if told > MAX_TOLD:
        problems.append(f"{_shown(name)}: {told - MAX_TOLD} more of its files are refused")
    return list(found.values())


def _member_opener(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Callable[[], IO[bytes]]:
    return lambda: archive.open(member)


def _check_directory(stream: IO[bytes]) -> None:
    """Refuse a zip whose table of contents would not fit."""
    try:
        listed = learners_archives.listing(stream)
    except learners_archives.BadArchive:
        raise Refused("is no zip (if it is an archive of another kind, unpack it and give the folder)") from None
    if listed.entries > MAX_ENTRIES or listed.size > MAX_DIRECTORY:
        raise Refused(f"has more than {MAX_ENTRIES} entries")
    stream.seek(0)


def _check_member(member: zipfile.ZipInfo) -> None:
    if stat.S_ISLNK(member.external_attr >> 16):
        raise Refused("is a link, which is not followed")
    if member.flag_bits & 1:
        raise Refused("is encrypted")
    if member.file_size > MAX_FILE:
        raise Refused(f"is larger than {MAX_FILE >> 20} MB")
    if member.file_size > BOMB_BYTES and member.file_size > BOMB_RATIO * max(member.compress_size, 1):
        raise Refused("unpacks to more than two hundred times its size")


def _safe_path(name: str, named: Callable[[str], bool], names: Collection[str]) -> str | None:
    """A member's path in our notation; None for what is nobody's work. Raises: Refused if it leads elsewhere."""
    name = name.replace("\\", "/")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if name.startswith("/") or ".." in parts or (parts and len(parts[0]) == 2 and parts[0][1] == ":"):
        raise Refused("would be written outside its folder")
    if len(parts) > MAX_DEPTH or len(name.encode(errors="replace")) > intake.MAX_PATH:
        raise Refused(f"lies more than {MAX_DEPTH} folders deep, or has a name of more than {intake.MAX_PATH} bytes")
    if REPOSITORY in parts:
        return "/".join([*parts[: parts.index(REPOSITORY) + 1], "HEAD"])
    folder = name.rstrip("/").rpartition("/")[0]
    if not parts or any(_is_nobodys(part, named, lambda twin: f"{folder}/{twin}".lstrip("/") in names) for part in parts):
        return None
    if any(_clean(part) != part for part in parts):
        raise Refused("has a name that can't be written down")
    return unicodedata.normalize("NFC", "/".join(parts))


def _is_nobodys(name: str, named: Callable[[str], bool], there: Callable[[str], bool]) -> bool:
    """Whether nobody has handed in a file of this name; `there` says of a name whether it lies in the same folder."""
    if not is_junk(name):
        return False
    beside = name.startswith("~$") or (name.startswith("._") and there(name.removeprefix("._")))  # what Word and macOS write
    return beside or not named(name)


def _clean(name: str) -> str:
    return clean_text(name, 255).replace("\n", " ").replace("\t", " ")


def _shown(name: str) -> str:
    return clean_text(name, 200).replace("\n", " ").replace("\t", " ")


def nested(entry: Entry, stack: ExitStack, problems: list[str], named: Callable[[str], bool] = lambda name: False) -> list[Entry]:
    """The files of a zip inside a download; zips in it stay closed. Raises: Refused.

    It is opened anew for each file: a class hands in more zips than a process may keep open.
    """
    path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "inner.zip"
    with open(path, "wb") as spool:
        for piece in chunks(entry):
            spool.write(piece)

    def opener(member: zipfile.ZipInfo) -> Callable[[], IO[bytes]]:
        return lambda: zipfile.ZipFile(path).open(member)

    with ExitStack() as own:
        inside = of_zip(_opener(path), entry.shown, own, problems, opener, named)
    return [Entry(file.path, file.size, file.open, f"{entry.shown}/{file.path}") for file in inside]
