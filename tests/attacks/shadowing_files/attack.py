"""Files beside the notebook with the names of what the worker imports, each of which would end it. What is handed in comes last
on the path."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write

EXIT = "import os\nos._exit(0)\n"


def make(folder: Path, notebook: NotebookNode) -> None:
    for name in (
        "torch",
        "numpy",
        "json",
        "course_lib",
        "safetensors",
        "sitecustomize",
        "usercustomize",
        "select",
        "dataclasses",
    ):
        (folder / f"{name}.py").write_text(EXIT)
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(EXIT)
    write(folder, notebook)
