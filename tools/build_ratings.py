"""Make course_lib/data/ratings.parquet out of the source distribution of vaderSentiment 3.3.2.

    pip download vaderSentiment==3.3.2 --no-binary :all: --no-deps
    python tools/build_ratings.py vaderSentiment-3.3.2.tar.gz

The distribution carries the data of Hutto and Gilbert (2014): snippets of four kinds, each rated by some 20 people from -4 to 4. Every
snippet and every rating is kept; of the texts, only HTML entities, quotation marks and runs of spaces are tidied. A snippet's split
follows from its own text, so no draw is involved and repeated texts share a split. The same archive and the same pyarrow give the
same file, byte for byte; its SHA-256, printed at the end, is the one in course_lib/language/preferences.py.
"""

from __future__ import annotations

import hashlib
import html
import io
import json
import re
import sys
import tarfile
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from autograder.paths import COURSE_LIB

ARCHIVE_SHA256 = "5d7c06e027fc8b99238edb0d53d970cf97066ef97654009890b83703849632f9"
INNER = "vaderSentiment-3.3.2/additional_resources/hutto_ICWSM_2014.tar.gz"
LICENCE = "vaderSentiment-3.3.2/LICENSE.txt"
FILES = {
    "film": "movieReviewSnippets",
    "amazon": "amazonReviewSnippets",
    "news": "nytEditorialSnippets",
    "tweet": "tweets",
}
SPLITS = (
    ("policy", 0.38),
    ("validation", 0.40),
    ("reward_model", 0.65),
    ("gold", 0.90),
    ("test", 1.0),
)  # upper ends of the shares


def tidy(text: str) -> str:
    """The text without HTML entities, typewriter quotation marks and the gaps that removed dashes have left."""
    return " ".join(html.unescape(text).replace("''", '"').split())


def split_of(text: str) -> str:
    """The split of a snippet: a hash of its letters and digits, so that spellings of one sentence stay together."""
    letters = re.sub(r"[^a-z0-9]", "", text.lower())
    position = int(hashlib.sha256(letters.encode()).hexdigest()[:12], 16) / 16**12
    return next(name for name, end in SPLITS if position < end)


def rows(folder: tarfile.TarFile, source: str, stem: str):
    """(id, text, ratings) of one source, in the order of the archive's files; they hold text and ratings apart."""

    def lines(kind: str):
        text = folder.extractfile(f"hutto_ICWSM_2014/{stem}_{kind}.txt").read().decode("utf-8-sig")
        return [line.split("\t") for line in text.splitlines() if line]

    ratings = {fields[0]: json.loads(fields[3]) for fields in lines("anonDataRatings")}
    for identity, _mean, text in lines("GroundTruth"):
        yield f"{source}-{identity}", tidy(text), ratings[identity]


def main(archive: Path) -> None:
    payload = archive.read_bytes()
    if hashlib.sha256(payload).hexdigest() != ARCHIVE_SHA256:
        raise SystemExit(f"{archive} is not the source distribution of vaderSentiment 3.3.2: its SHA-256 differs")
    columns: dict[str, list] = {"source": [], "id": [], "split": [], "text": [], "ratings": []}
    with tarfile.open(fileobj=io.BytesIO(payload)) as outer:
        licence = outer.extractfile(LICENCE).read().decode()
        with tarfile.open(fileobj=outer.extractfile(INNER)) as inner:
            for source, stem in FILES.items():
                for identity, text, ratings in rows(inner, source, stem):
                    for name, value in zip(columns, (source, identity, split_of(text), text, ratings), strict=True):
                        columns[name].append(value)
    types = {"source": pa.string(), "id": pa.string(), "split": pa.string(), "text": pa.string(), "ratings": pa.list_(pa.int8())}
    table = pa.table({name: pa.array(values, types[name]) for name, values in columns.items()})
    table = table.replace_schema_metadata(
        {
            "title": "Snippets of text with the sentiment ratings of some 20 people each, from -4 to 4",
            "source": "PyPI, vaderSentiment-3.3.2.tar.gz, additional_resources/hutto_ICWSM_2014.tar.gz",
            "source_sha256": ARCHIVE_SHA256,
            "citation": "Hutto, C. J. and Gilbert, E. (2014). VADER: a parsimonious rule-based model for sentiment analysis of"
            " social media text. Proceedings of ICWSM 2014.",
            "licence": licence,
            "made_by": "tools/build_ratings.py",
        }
    )
    target = COURSE_LIB / "data" / "ratings.parquet"
    pq.write_table(table, target, compression="zstd", compression_level=19, use_dictionary=["source", "split"])
    print(f"{target}: {table.num_rows} snippets, {target.stat().st_size / 1e6:.2f} MB")
    print("SHA-256", hashlib.sha256(target.read_bytes()).hexdigest())


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]))
