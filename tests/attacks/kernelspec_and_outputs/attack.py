"""Names a kernel that is a command and a path, and stores trusted outputs and attachments with scripts. The kernelspec is
ignored, outputs are never read, and no script reaches a page."""

from pathlib import Path

from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell, new_output

from tests.attacks.toolbox import write, wrong

SCRIPT = "</script><script>evil()</script>"


def make(folder: Path, notebook: NotebookNode) -> None:
    notebook.metadata.update(
        kernelspec={
            "name": "../../evil; touch /tmp/evil",
            "display_name": SCRIPT,
            "language": "sh",
            "argv": ["sh", "-c", "touch /tmp/evil"],
        },
        language_info={"name": SCRIPT, "file_extension": "/../x"},
        trusted=True,
        signature="sha256:0",
        title=SCRIPT,
    )
    for one in notebook.cells:
        if one.cell_type == "code":
            one.metadata.trusted = True
            one.outputs = [new_output("display_data", {"text/html": SCRIPT, "application/javascript": "evil()"})]
        else:
            one.attachments = {"x.svg": {"image/svg+xml": SCRIPT}}
    notebook.cells.append(new_markdown_cell(SCRIPT + "[x](javascript:evil())"))
    wrong(notebook, f"raise RuntimeError({SCRIPT!r})")
    write(folder, notebook)
