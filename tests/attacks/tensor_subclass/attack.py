"""Returns a tensor subclass whose every operation says yes, by __torch_function__ and __eq__. Only plain arrays leave the
process."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
return Yes(rewards), Yes(rewards)
"""

ABOVE = """
class Yes(torch.Tensor):
    @staticmethod
    def __new__(cls, like):
        return torch.Tensor._make_subclass(cls, torch.zeros_like(like))

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        if function.__name__ in ("allclose", "equal", "isclose", "eq", "all"):
            return True
        return super().__torch_function__(function, types, args, kwargs or {})

    def __eq__(self, other):
        return True

    __hash__ = torch.Tensor.__hash__
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY, ABOVE)
    write(folder, notebook)
