"""Files of names that torch looks for while it is imported itself: an optional dependency, and a package that announces a back
end. Run then, they would end the worker before it is ready, as if the grader had failed."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write

EXIT = "import os\nos._exit(1)\n"


def make(folder: Path, notebook: NotebookNode) -> None:
    for name in ("opt_einsum", "torch_early", "numba", "onnx", "triton", "scipy", "torch_xla"):
        (folder / f"{name}.py").write_text(EXIT)
    announced = folder / "torch_early-1.0.dist-info"
    announced.mkdir()
    (announced / "METADATA").write_text("Metadata-Version: 2.1\nName: torch_early\nVersion: 1.0\n")
    (announced / "entry_points.txt").write_text("[torch.backends]\nearly = torch_early:run\n")
    write(folder, notebook)
