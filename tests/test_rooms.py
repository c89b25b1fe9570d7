"""Imports between the project's packages, and between the rooms of each, go one way: pyproject.toml says which (import-linter)."""

from importlinter.application.use_cases import lint_imports
from importlinter.configuration import configure


def test_imports_between_rooms_go_one_way(capsys):
    configure()
    assert lint_imports(cache_dir=None), capsys.readouterr().out
