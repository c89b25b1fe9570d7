"""Citations as plain text, from a BibTeX file: what the student notebook shows where the book has links."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from pybtex.database import BibliographyData, Entry, parse_file
from pybtex.plugin import find_plugin
from pybtex.richtext import Text


class Bibliography:
    """The entries of one BibTeX file, read when first asked for. Unknown keys raise KeyError."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def _data(self) -> BibliographyData:
        return parse_file(str(self.path), "bibtex")

    def cite(self, keys: Iterable[str], parenthesised: bool) -> str:
        """`Schulman et al. (2016)`, or `(Schulman et al., 2016)` if parenthesised."""
        works = [(_authors(self._data.entries[key]), self._data.entries[key].fields["year"]) for key in keys]
        if parenthesised:
            return "(" + "; ".join(f"{authors}, {year}" for authors, year in works) + ")"
        return " and ".join(f"{authors} ({year})" for authors, year in works)

    def listing(self, keys: Iterable[str]) -> str:
        """A Markdown list of the works under `keys`, sorted by author."""
        style = find_plugin("pybtex.style.formatting", "plain")()
        backend = find_plugin("pybtex.backends", "markdown")()
        formatted = style.format_bibliography(self._data, sorted(keys))
        works = (entry.text.render(backend).replace("\n", " ") for entry in formatted)
        return "\n".join("- " + re.sub(r"\\([.()-])", r"\1", work) for work in works)  # escapes that these texts do not need


def _authors(entry: Entry) -> str:
    people = entry.persons.get("author") or entry.persons["editor"]
    names = [
        str(Text.from_latex(" ".join(person.prelast_names + person.last_names))) for person in people
    ]  # render_as takes 40 ms
    return names[0] + " et al." if len(names) > 2 else " and ".join(names)
