"""How the cells of honest notebooks run, and what is said of those that stop: each case by itself, in forks of one warm process.

A case is a function of the perfect notebook of chapter 44, named as what it does; its decorator says what must come out.
"""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace

import nbformat
import pytest

from autograder.grading import intake, judge
from tests.attacks import toolbox
from tests.field.warm import Warm

CASES = {}


def place(name):
    """Which of the perfect notebook's code cells answers an exercise, counted from 1; prose and examples may come and go."""
    notebook = toolbox.solved()
    return [one for one in notebook.cells if one.cell_type == "code"].index(toolbox.cell(notebook, name)) + 1


SUMS = place("lambda_returns")
BEGIN = "^It calls %s: begin there\\.\n"
BOTH = BEGIN % "td_residuals and compute_gae, which do not pass their own checks"


def case(score=10.0, flags=(), says=None, status="graded"):
    """What must come out: the score, exactly these flags (patterns), exercise → pattern in its message, the status."""

    def keep(make):
        CASES[make.__name__] = SimpleNamespace(make=make, score=score, flags=flags, says=says or {}, status=status)
        return make

    return keep


class Notebook:
    """The perfect notebook, being edited."""

    def __init__(self):
        self.node, self.files = toolbox.solved(), {}
        self.setup = next(one for one in self.node.cells if one.cell_type == "code")

    def find(self, name):
        return toolbox.cell(self.node, name)

    def live(self):
        return [one for one in self.node.cells if one.cell_type == "code" and "live" in one.metadata.get("tags", [])]

    def on_top(self, source):
        """Above the imports, in their cell."""
        self.setup.source = source + "\n" + self.setup.source

    def before(self, name, source):
        self.node.cells.insert(self.node.cells.index(self.find(name)), nbformat.v4.new_code_cell(source))

    def change(self, name, old, new):
        cell = self.find(name)
        assert old in cell.source, (old, cell.source)
        cell.source = cell.source.replace(old, new)

    def sum_is(self, expression):
        """What lambda_returns returns, before it is detached."""
        self.change("lambda_returns", "(advantages + values)", expression)

    def within(self, name, line):
        """A line before the last one of an answer."""
        lines = self.find(name).source.rstrip().splitlines()
        self.find(name).source = "\n".join([*lines[:-1], f"    {line}", lines[-1]]) + "\n"


@pytest.fixture(scope="module")
def warm():
    one = Warm([judge.COURSE_LIB])
    yield one
    one.close()


@pytest.fixture
def judged(monkeypatch, tmp_path, warm):
    """Notebook → verdict."""
    monkeypatch.setattr(judge, "Sandbox", warm.sandbox)

    def judged(notebook, timeout=10.0):
        folder = tmp_path / "ch44"
        folder.mkdir()
        toolbox.write(folder, notebook.node)
        for name, content in notebook.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(content)
        return judge.judge(intake.read("s", "ch44", folder), judge.released("ch44"), timeout, trusted=True)

    return judged


# ---------------------------------------------------------------- a statement fails; the rest of its cell runs

SEABORN = r"cell_1_stopped: line 1, ModuleNotFoundError: No module named 'seaborn'"


@case(flags=[SEABORN])
def seaborn_import(nb):
    nb.on_top("import seaborn as sns")


@case(flags=[SEABORN])
def seaborn_among_others(nb):
    nb.on_top("import seaborn, copy")
    nb.sum_is("copy.copy(advantages + values)")


@case()
def seaborn_in_a_cell_of_its_own(nb):
    nb.before("td_residuals", "import seaborn as sns\nimport pandas as pd\n")


@case(
    7.0, [SEABORN],
    dict.fromkeys(
        ("lambda_returns", "repaired_targets"),
        "NameError: name 'sns' is not defined; code cell 1 stopped at line 1: ModuleNotFoundError: No module named 'seaborn'$",
    ),
)  # fmt: skip
def seaborn_used(nb):
    nb.on_top("import seaborn as sns")
    nb.within("lambda_returns", "sns.set_theme()")


@case(
    7.0,
    ["cell_1_stopped: line 1, .*einops", f"cell_{SUMS}_stopped: line 1, NameError: name 'Float'"],
    {
        "lambda_returns": f"; code cell 1 stopped at line 1: .*einops'; code cell {SUMS} stopped at line 1: NameError: name 'Float'"
    },
)
def annotated_with_what_is_missing(nb):
    nb.on_top("from einops import rearrange\nfrom jaxtyping import Float\n")
    nb.change("lambda_returns", "values):", "values: Float):")


@case(flags=["cell_1_stopped: line 1, EOFError: input\\(\\) waits for somebody to type"])
def input_in_imports(nb):
    nb.on_top("student = input('Your name: ')")


@case(7.0, says={"lambda_returns": "EOFError: input\\(\\) waits"})
def input_in_an_answer(nb):
    nb.within("lambda_returns", "input()")


@case(flags=["cell_1_stopped: line 13, ImportError: Cannot load backend 'TkAgg'"])
def widgets_and_bars(nb):
    nb.on_top(
        "%matplotlib widget\nimport matplotlib\nmatplotlib.use('TkAgg')\nimport matplotlib.pyplot as plt\n"
        "from tqdm.notebook import tqdm, trange\nfrom IPython.display import HTML, Video, clear_output, display\n"
        "import ipywidgets as widgets\nfor _ in trange(3):\n    pass\nclear_output(wait=True)\ndisplay(HTML('<b>x</b>'))\n"
        "widgets.interact(lambda x: plt.plot([x]), x=(0, 3))\nplt.show(block=True)\n"
    )


@case(flags=["cell_1_stopped: line 1, ModuleNotFoundError: No module named 'google"])
def colab_unguarded(nb):
    nb.on_top("from google.colab import drive\ndrive.mount('/content/drive')\n%cd /content/drive/MyDrive\n")


@case()
def colab_guarded(nb):
    nb.on_top("try:\n    from google.colab import drive\nexcept ImportError:\n    drive = None\nfrom tqdm.auto import tqdm\n")


@case(flags=[f"cell_{SUMS}_stopped: line 3, ZeroDivisionError"])
def a_statement_that_fails_runs_no_other_twice(nb):
    nb.before("lambda_returns", "calls = []\ncalls.append(1)\n1 / 0\ncalls.append(2)\n")
    nb.sum_is("(advantages + values + (sum(calls) - 3))")


@case(flags=[f"cell_{SUMS}_stopped: line [0-9]+, AssertionError"])
def a_test_of_ones_own_that_fails(nb):
    nb.find("lambda_returns").source += "\n\nassert False, 'not yet'\n"


@case(flags=[f"cell_{SUMS}_stopped: line [0-9]+, SystemExit"])
def the_end_of_a_cell_by_sys_exit(nb):
    nb.find("lambda_returns").source += "\n\nimport sys\nsys.exit()\nraise KeyError\n"


@case()
def exit_and_quit(nb):
    nb.find("lambda_returns").source = "exit()\nquit\n" + nb.find("lambda_returns").source


@case(
    8.0,
    ["cell_1_stopped"],
    {"repaired_targets": "ImportError.*; code cell 1 stopped at line 1: ImportError: cannot import name 'no_such'"},
)
def a_name_that_cannot_be_imported(nb):
    nb.on_top("from math import no_such")
    nb.within("repaired_targets", "from math import no_such")


# ---------------------------------------------------------------- names that only live cells have


@case()
def numpy_from_live(nb):
    assert "import numpy as np" not in nb.setup.source
    nb.within("repaired_targets", "gamma = np.float64(gamma).item()")
    assert any("import numpy as np" in one.source for one in nb.live())


@case()
def helper_in_live(nb):
    nb.live()[
        0
    ].source += "\n\nFACTOR = 1.0\ndef scaled(a):\n    return FACTOR * a\ndef my_sum(a, b):\n    return scaled(a) + b\n"
    nb.sum_is("my_sum(advantages, values)")


MARKED = "my_sum stands in a text cell, which does not run: make it a code cell"


@case(7.0, [f"text_cell: {MARKED}"], {"lambda_returns": f"'my_sum' is not defined; {MARKED}"})
def helper_in_text(nb):
    next(one for one in nb.node.cells if one.cell_type == "markdown").source += "\n\ndef my_sum(a, b):\n    return a + b\n"
    nb.sum_is("my_sum(advantages, values)")


@case(7.0, says={"lambda_returns": "NameError: name 'trained' is not defined"})
def a_value_that_a_live_cell_computes(nb):
    nb.live()[0].source += "\ntrained = sum([0.0])\n"
    nb.sum_is("(advantages + values + trained)")


@case()
def an_endless_live_cell_costs_nothing(nb):
    nb.live()[0].source = "while True:\n    pass\n"


# ---------------------------------------------------------------- syntax


def newer(version, saved=""):
    """What must come out for an answer in the syntax of `version`: all points where this Python reads it."""
    if sys.version_info >= tuple(map(int, version.split("."))):
        return {}
    message = (
        f"code cell {SUMS} is written for Python {version} \\({saved or f'newer than {judge.PYTHON}'}\\), and this is graded with"
    )
    message += f" Python {judge.PYTHON}: a person will look at it"
    flags = [
        f"cell_{SUMS}_stopped: line [0-9]+, SyntaxError",
        f"newer_python: cell {SUMS} needs {version}, graded with {judge.PYTHON}",
    ]
    return {
        "score": 7.0,
        "flags": flags,
        "status": "needs_review",
        "says": dict.fromkeys(("lambda_returns", "repaired_targets"), message),
    }


NESTED = 'text = f"shapes {", ".join(str(x.shape) for x in (advantages, values))}"'


@case(**newer("3.12"))
def fstring_312(nb):
    nb.within("lambda_returns", NESTED)


@case(**newer("3.12", "Python 3.12.7 saved the notebook"))
def fstring_312_saved_by_312(nb):
    nb.within("lambda_returns", NESTED)
    nb.node.metadata["language_info"] = {"name": "python", "version": "3.12.7"}


@case(**newer("3.12"))
def type_parameters(nb):
    nb.change("lambda_returns", "def lambda_returns(", "type Pair[T] = tuple[T, T]\n\n\ndef lambda_returns[T](")


@case(**newer("3.14"))
def exceptions_without_brackets(nb):
    nb.change(
        "lambda_returns", "    return", "    try:\n        pass\n    except ValueError, TypeError:\n        pass\n    return"
    )


@case(7.0, [f"cell_{SUMS}_stopped: line [0-9]+, SyntaxError"], {"lambda_returns": "SyntaxError"})
def wrong_syntax_in_a_notebook_of_312(nb):
    nb.sum_is("(advantages + values")
    nb.node.metadata["language_info"] = {"name": "python", "version": "3.12.7"}


@case()
def newer_syntax_in_a_cell_that_nothing_needs(nb):
    nb.before("lambda_returns", 'print(f"{"a"}")\n')


@case()
def nbsp(nb):
    nb.change("lambda_returns", "    return", "\u00a0\u00a0\u00a0\u00a0return")
    nb.within("compute_gae", 'assert "\u00a0" == chr(160)\u3000\u200b')


# ---------------------------------------------------------------- PyTorch, packages, machines


@case()
def compiled(nb):
    nb.find("lambda_returns").source = "@torch.compile(fullgraph=True)\n" + nb.find("lambda_returns").source
    nb.before("td_residuals", "@torch.compile\ndef kept(x):\n    return ~x\n")
    nb.change("td_residuals", "~terminated", "kept(terminated)")


@case()
def jit_script(nb):
    nb.before("lambda_returns", "@torch.jit.script\ndef added(a, b):\n    return a + b\n")
    nb.sum_is("added(advantages, values)")


@case()
def scipy_gae(nb):
    nb.find("lambda_returns").source = (
        "import scipy.signal\n\n\ndef discount(x, d):\n    return scipy.signal.lfilter([1], [1, -d], x[::-1], axis=0)[::-1]\n\n\n"
        + nb.find("lambda_returns").source
    )
    nb.sum_is("(advantages + values + discount(torch.zeros(3).numpy(), 0.9).sum().item())")


GPU = "There is no GPU where this is graded"


@case(7.0, says={"lambda_returns": GPU, "repaired_targets": GPU})
def moved_to_cuda(nb):
    nb.sum_is("(advantages.cuda() + values.cuda()).cpu()")


@case()
def cuda_if_there(nb):
    nb.setup.source += "\ntorch.set_default_device(torch.device('cuda' if torch.cuda.is_available() else 'cpu'))\n"


@case()
def breakpoint_left(nb):
    nb.within("lambda_returns", "import pdb; pdb.set_trace(); breakpoint()")
    nb.within("td_residuals", "from IPython.core.debugger import set_trace; set_trace()")


CALLED = r"called as compute_gae\(rewards, values, next_values, terminated, truncated\), and also with gamma and gae_lambda"


@case(5.0, says={"compute_gae": CALLED})
def keyword_only(nb):
    cell = nb.find("compute_gae")
    head = "def compute_gae(rewards, values, next_values, terminated, truncated, *, discount=0.99, lam=0.95)"
    cell.source = re.sub(r"def compute_gae\(.*?\)(?=:)", head, cell.source, flags=re.DOTALL)
    cell.source = re.sub(r"\bgamma\b(?!=)", "discount", cell.source).replace("gae_lambda", "lam")


@case(5.0, says={"compute_gae": CALLED, "td_residuals": "gamma"})
def no_defaults(nb):
    for name in ("compute_gae", "td_residuals"):
        cell = nb.find(name)
        cell.source = re.sub(r"(gamma|gae_lambda)=0\.\d+", r"\1", cell.source)


# ---------------------------------------------------------------- pools


@case()
def thread_pool(nb):
    nb.before(
        "lambda_returns",
        "from concurrent.futures import ThreadPoolExecutor\npool = ThreadPoolExecutor(2)\nlist(pool.map(abs, range(4)))\n",
    )
    nb.change(
        "lambda_returns",
        "return (advantages + values).detach()",
        "return list(pool.map(lambda x: x, [(advantages + values).detach()]))[0]",
    )


@case()
def multiprocessing_thread_pool(nb):
    nb.before("lambda_returns", "from multiprocessing.pool import ThreadPool\npool = ThreadPool(2)\npool.map(abs, range(4))\n")
    nb.change(
        "lambda_returns",
        "return (advantages + values).detach()",
        "return pool.map(lambda x: x, [(advantages + values).detach()])[0]",
    )


@case()
def pools_of_processes(nb):
    nb.before(
        "lambda_returns",
        "import multiprocessing, torch.multiprocessing as mp\nfrom concurrent.futures import ProcessPoolExecutor\n"
        "def square(x):\n    return x * x\nwith mp.Pool(2) as first:\n    first.map(square, range(4))\n"
        "pool = multiprocessing.Pool(2)\npool.map(square, [1])\nother = ProcessPoolExecutor(2)\nlist(other.map(square, [1]))\n",
    )
    nb.sum_is("(advantages + values + pool.map(square, [0])[0] + list(other.map(square, [0]))[0])")


# ---------------------------------------------------------------- what every notebook can


@case(3.0, says={"compute_gae": BEGIN % "td_residuals, which does not pass its own check", "repaired_targets": BOTH})
def what_fails_by_another_exercise_says_where_to_begin(nb):
    nb.change("td_residuals", "gamma * next_values", "next_values")


@case(
    7.0, says={"lambda_returns": "^(?!It calls)", "repaired_targets": BEGIN % "lambda_returns, which does not pass its own check"}
)
def what_calls_right_ones_does_not(nb):
    nb.sum_is("(advantages - values)")


@case()
def history(nb):
    nb.before("lambda_returns", "2 + 3\n")
    nb.before("lambda_returns", "OFFSET = _ - 5 + Out[max(Out)] - 5 + len(In[-1]) * 0\n")
    nb.sum_is("(advantages + values + OFFSET)")


@case()
def folders(nb):
    nb.files = {"src/deep/helpers.py": "def keep(x):\n    return ~x\n", "data/n.txt": "0"}
    nb.before(
        "td_residuals",
        "import os\nos.chdir('src')\n%cd deep\nfrom helpers import keep\nos.chdir('../..')\nOFFSET = float(open('data/n.txt').read())\n",
    )
    nb.change("td_residuals", "~terminated", "keep(terminated)")
    nb.sum_is("(advantages + values + OFFSET)")


@case()
def magics_without_their_sign(nb):
    for line in ("pip install -q einops", "ls", "cd ..", "matplotlib inline", "ls -l data", "load_ext autoreload"):
        nb.before("td_residuals", line)


@case()
def settings(nb):
    nb.setup.source += (
        "\nimport warnings, numpy as np, faulthandler\nfrom math import *\nwarnings.filterwarnings('error')\nnp.seterr(all='raise')\n"
        "np.random.seed(0)\ntorch.autograd.set_detect_anomaly(True)\ntorch.use_deterministic_algorithms(True)\nfaulthandler.enable()\n"
        "torch.set_default_dtype(torch.float64)\ntorch.set_grad_enabled(False)\n"
        "if __name__ == '__main__':\n    import torch\nimport asyncio\nasync def one():\n    return 1\nasyncio.run(one())\n"
    )


@case()
def of_other_tools(nb):
    nb.on_top(
        "%config InlineBackend.figure_format = 'retina'\n%precision 3\n%env X=1\n%conda install x\nfiles = !ls\nassert files.n == ''\n"
        "?print\n!!ls\nout = %sql SELECT 1\n%store files\n%who\nget_ipython().system('ls')\nget_ipython().magic('matplotlib inline')\n"
        "from IPython import get_ipython\nget_ipython().run_line_magic('x', '')\n"
    )
    for magic in ("html", "javascript", "latex", "bash", "timeit -n1 x = 1"):
        nb.before("td_residuals", f"%%{magic}\nraise_ = 1\n")
    nb.before("lambda_returns", "t = %timeit -o -n 1 sum([1])\n%time OFFSET = 0.0 * t.best\n")
    nb.sum_is("(advantages + values\n        + 7 % 7 + OFFSET)")


@pytest.mark.parametrize("name", CASES)
def test_case(judged, name):
    expected, notebook = CASES[name], Notebook()
    expected.make(notebook)
    verdict = judged(notebook)
    assert (verdict.status, verdict.score) == (expected.status, expected.score), verdict
    assert len(verdict.flags) == len(expected.flags), verdict.flags
    for pattern, flag in zip(expected.flags, verdict.flags, strict=True):
        assert re.match(pattern, flag)
    messages = {item.exercise: item.message for item in verdict.items}
    for exercise, pattern in expected.says.items():
        assert re.search(pattern, messages[exercise]), messages
