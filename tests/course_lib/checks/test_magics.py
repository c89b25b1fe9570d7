"""A cell means what it means in IPython, without its side effects; plain Python means what it always means."""

import subprocess
import sys
import traceback

import pytest

from course_lib.checks.notebook import new_namespace, run_cell, run_definitions

HELPERS = "%%writefile helpers.py\ndef keep(x):\n    return x + 1\n"


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])
    monkeypatch.chdir(tmp_path)


def after(*cells):
    namespace = new_namespace()
    for number, source in enumerate(cells, start=1):
        run_cell(source, namespace, f"cell {number}")
    return namespace


@pytest.mark.parametrize(
    ("cells", "a"),
    [
        # no line of code goes, whatever its comment says
        (["%%time\ndef f(x):\n    x = x + 1\n    x = 2 * x  # needed?\n    return x\na = f(1)"], 4),
        (["%%timeit\na = 3  # both sides?"], 3),
        (["a = 1  # one?\n%matplotlib inline"], 1),
        (["a = (7\n    % 4)\n%matplotlib inline"], 3),
        (["%%time\na = '''\n%d\n!x\n?'''"], "\n%d\n!x\n?"),
        (["%load_ext x\nif 1:\n    %time b = 1\n    a = b"], 1),
        # help
        (["a = 3\na?\n?a\na??\n??a\nprint?\n?\n%time?\na.b.c?\n"], 3),
        # shell
        (["!pip install -q \\\n    einops\na = 1"], 1),
        (["a = !ls"], []),
        (["a = !ls \\\n -l\na = (a.n, len(a))"], ("", 0)),
        (["a = %sx ls"], []),
        (["!!ls\na = 1"], 1),
        (["for x in range(2):\n    !echo {x}\na = x"], 1),
        (["a = get_ipython().getoutput('ls')"], []),
        (["a = get_ipython().system('ls')"], None),
        # line magics
        (["a = %pip install x"], None),
        (["%env FIELD=1\na = %env FIELD"], "1"),
        (["%set_env FIELD 2\nimport os\na = os.environ['FIELD']"], "2"),
        (["a = %env NO_SUCH_VARIABLE"], None),
        (["import os\nhere = os.getcwd()\n%cd ..\na = os.getcwd() == here"], True),
        (["%load_ext autoreload\n%autoreload 2\n%unknown x y\n%config InlineBackend.figure_format = 'svg'\na = 1"], 1),
        (["%time a = 3"], 3),
        (["%time b = 3\na = %time b + 1"], 4),
        (["def f(b):\n    c = %time b + 1\n    return c\na = f(2)"], 3),
        (["%prun -s cumtime a = 3"], 3),
        (["t = %timeit -n 2 -r 3 -o sum(range(9))\na = (t.loops, t.best >= 0, t.average >= 0)"], (1, True, True)),
        (["%timeit -v t sum(range(9))\na = t.loops"], 1),
        (["a = 1\n%timeit a = 2"], 1),
        (["get_ipython().run_line_magic('matplotlib', 'inline')\na = 1"], 1),
        (["get_ipython().magic('matplotlib inline')\na = 1"], 1),
        (["%pylab inline\na = float(np.pi) > 3"], True),
        # cell magics
        (["%%time\na = 1"], 1),
        (["\n\n%%time\na = 1"], 1),
        (["%%capture out\nprint(3)", "a = out.stdout"], "3\n"),
        (["%%capture\n%%time\na = 1"], 1),
        (["%%prun -s cumtime\na = 1"], 1),
        (["%%memit\na = 1"], 1),
        (["%%time\n!ls\n%time a = 1"], 1),
        (["%%timeit -n 9 b = 2\na = [b for _ in range(2)]"], [2, 2]),
        (["a = 1", "%%timeit\na = 2"], 1),
        (["get_ipython().run_cell_magic('time', '', 'a = 1\\n')"], 1),
        *((["a = 1", f"%%{name}\na = 2"], 1) for name in ("bash", "html", "javascript", "script python", "python", "R", "latex")),
        (["a = 1", "\n\n%%bash\na = 2"], 1),
        (["a = 1", "%%unknown\nSELECT a FROM b;"], 1),
        (["from IPython.core.magic import *\n@register_line_magic\ndef twice(x):\n    return 2 * int(x)\na = %twice 4"], 8),
        (["from IPython.core.magic import *\n@register_cell_magic\ndef up(line, cell):\n    global a\n    a = cell", "%%up\nx"], "x\n"),
        # files
        ([HELPERS, "%run helpers.py\na = keep(1)"], 2),
        ([HELPERS, "name = 'helpers'\n%run $name\na = keep(1)"], 2),
        ([HELPERS, HELPERS.replace("1", "2"), "%run helpers.py\na = keep(1)"], 3),
        ([HELPERS, "%%writefile -a helpers.py\nkept = keep(4)", "%run helpers\na = kept"], 5),
        (["%%writefile src/x.py\nraise SystemExit", "%run src/x.py\na = 1"], 1),
        # await, indents, prompts
        (["import asyncio\nawait asyncio.sleep(0)\na = 1"], 1),
        (["async def f():\n    return 1", "a = await f()"], 1),
        (["import asyncio\ntask = asyncio.ensure_future(asyncio.sleep(0, 5))\nawait asyncio.sleep(0)", "a = await task"], 5),
        (["    b = 1\n    a = b"], 1),
        ([">>> def f():\n...     return 2\n...\n>>> a = f()\n"], 2),
        (["In [1]: b = 3\n   ...: a = b"], 3),
        # what a shell is asked
        (["a = 'google.colab' in str(get_ipython())"], False),
        (["from IPython import get_ipython\nip = get_ipython()\nif ip is not None:\n    ip.run_line_magic('x', '')\n%cd\na = 1"], 1),
        (["ip = get_ipython()\nip.events.register('x', 1)\nip.ast_node_interactivity = 'all'\nip.set_hook('a', 1)\na = ip.kernel"], None),
        (["get_ipython().display_formatter.formatters['text/html'].enabled = False\na = 1"], 1),
        (["a = 'IPKernelApp' in get_ipython().config"], False),
        (["get_ipython().ex('b = 1')\nget_ipython().push({'c': 2})\na = get_ipython().ev('b + c')"], 3),
        # plain Python
        (["class A:\n    x: int = 1\na = A.__annotations__['x']"], int),
        (["from __future__ import annotations", "class A:\n    x: Unknown = 1\na = A.__annotations__['x']"], "Unknown"),
        (["import inspect\ndef f():\n    return 1\na = inspect.getsource(f)"], "def f():\n    return 1\n"),
        (["globals().pop('__shell__')", "a = 1"], 1),
    ],
)  # fmt: skip
def test_a_cell_means_what_it_means_in_ipython(cells, a):
    assert after(*cells)["a"] == a


@pytest.mark.parametrize(
    "source",
    [
        "x = 3\n1/0",
        "\n\n!a \\\n b\n\nx = 1\n1/0",
        "\n%%time\n\nx = 1\n1/0",
        "%%time\n!a \\\n b\n%time 1/0",
        "%matplotlib inline\nx = 3\n1/0",
        "x = !a \\\n  b \\\n c\n%time 1/0",
        "if 1:\n    !a \\\n     b\n    1/0",
        "%%capture\n%%time\nx = (1,\n  2)\n1/0",
    ],
)
def test_lines_keep_their_numbers(source):
    with pytest.raises(ZeroDivisionError) as raised:
        after(source)
    frames = [frame for frame in traceback.extract_tb(raised.value.__traceback__) if frame.filename == "<cell 1>"]
    assert frames[-1].lineno == 1 + next(i for i, line in enumerate(source.splitlines()) if "1/0" in line)


@pytest.mark.parametrize(("source", "line"), [("x = 1\n\ndef f(:", 3), ("!ls\n\nx = = 1", 3), ("%%time\nx = 1\ny = (", 3)])
def test_wrong_syntax_is_named_where_it_stands(source, line):
    with pytest.raises(SyntaxError) as raised:
        after(source)
    assert raised.value.lineno == line


@pytest.mark.parametrize("name", ["../x.py", "/tmp/written-by-a-cell.py", "~/../x.py", "link/x.py"])
def test_files_are_written_below_the_working_directory_only(tmp_path, name):
    work = tmp_path / "work"
    work.mkdir()
    (work / "link").symlink_to(tmp_path)
    namespace = new_namespace()
    run_cell(f"import os; os.chdir({str(work)!r})", namespace)
    with pytest.raises(ValueError, match="below the working directory"):
        run_cell(f"%%writefile {name}\na", namespace)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["work"]


def test_of_a_cell_that_never_ends_what_it_defines_is_kept():
    namespace = new_namespace()
    endless = (
        "\nimport math\nK = 3\nhalf = lambda x: math.floor(x / 2)\nlost = print(3)\nmissing = lost\n"
        "def f():\n    return K\nwhile True:\n    pass"
    )
    for magic in ("", "%%time", "!ls"):
        run_definitions(magic + endless, namespace)
        assert namespace.pop("f")() == 3 and namespace.pop("half")(5) == 2 and "lost" not in namespace


def test_plain_python_does_not_import_ipython():
    code = (
        "import sys\nfrom course_lib.checks.notebook import new_namespace, run_cell\nnamespace = new_namespace()\n"
        "run_cell('get_ipython().run_line_magic(1, 2)', namespace)\nprint('IPython' in sys.modules)\n"
        "run_cell('from IPython import get_ipython\\nshell = get_ipython()', namespace)\n"
        "print(namespace['shell'] is namespace['__shell__'])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.split() == ["False", "True"]


def test_a_real_shell_stays_what_ipython_finds(monkeypatch):
    import IPython.core.getipython as module

    real = object()
    monkeypatch.setattr(module, "get_ipython", lambda: real)
    assert after("from IPython import get_ipython\na = get_ipython()")["a"] is real
