"""Returns an object that is equal to, and close to, whatever it is compared with. It is no tensor, and never compared."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
return Anything()
"""

ABOVE = """
class Anything(tuple):
    shape = property(lambda self: self)
    dtype = property(lambda self: self)
    __eq__ = __le__ = __ge__ = __lt__ = __gt__ = lambda self, other: True
    __ne__ = lambda self, other: False
    __sub__ = __rsub__ = __abs__ = __getattr__ = lambda self, *args: self
    __bool__ = lambda self: True
    __hash__ = tuple.__hash__
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY, ABOVE)
    write(folder, notebook)
