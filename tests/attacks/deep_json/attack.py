"""Brackets two hundred thousand deep: a parser that recurses overflows its stack."""

from pathlib import Path

from nbformat import NotebookNode


def make(folder: Path, notebook: NotebookNode) -> None:
    (folder / "ch44.ipynb").write_text('{"cells": ' + "[" * 200_000 + "]" * 200_000 + "}")
