"""Cells as IPython reads them: magics, `!commands`, `help?`, prompts and indents that were pasted, `await` outside a function.

IPython's own transformer says what such a cell means; `Shell` is what the result calls as `get_ipython()`, and does no harm. Plain
Python is compiled as it stands. A line keeps its number, and `from __future__` holds for the cells below, as in IPython. Unlike there,
a statement that fails does not keep those below it from running (an import that is missing would cost a whole cell); each runs once.

What the magics do here:

- shell commands do nothing and return empty output; so does every line magic that is not named below, and every `help?`;
- `%time` and `%prun` run their statement once where they stand, and `%time` has its value; `%timeit` runs it once, too, and `-o` gives
  a result made of that one run. As in IPython, a timed body replaces no name that the notebook has; a name that it has not is kept,
  so that an answer below a forgotten `%%timeit` still counts;
- `%run` runs a file or a notebook, `%%writefile` writes one below the working directory;
- a cell magic runs the body if it is Python (`%%time`, `%%capture`, `%%prun`, those of extensions), and not if it is another
  language's (`%%bash`, `%%html`) or another process's (`%%python`);
- magics that a cell registers itself are called, and a line that is a magic without its `%` (`pip install x`) is one;
- `%cd` goes to folders below the notebook's own, and `%env` sets what it says.
"""

from __future__ import annotations
import __future__

import ast
import functools
import importlib
import inspect
import linecache
import os
import re
import runpy
import shlex
import sys
import time
import types
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from course_lib.checks import names
from course_lib.checks.syntax import with_plain_spaces

NAME = "__shell__"  # of the shell, in the namespace that it runs cells in
FUTURES = functools.reduce(int.__or__, (getattr(__future__, name).compiler_flag for name in __future__.all_feature_names))
ELSEWHERE = frozenset(
    (
        *("!", "sx", "system", "cmd", "script", "sh", "shell", "bash", "python", "python2", "python3", "pypy", "skip"),
        *("html", "HTML", "javascript", "js", "latex", "markdown", "heading", "svg", "SVG", "mermaid", "dot", "ai"),
        *("R", "julia", "matlab", "octave", "perl", "ruby", "sql", "bigquery", "cpp", "cu", "nvcc"),
    )
)
"""Cell magics whose body is no Python, or none that runs in this process."""

AUTOMAGICS = frozenset((
    "pip", "conda", "mamba", "micromamba", "uv", "cd", "ls", "ll", "la", "lk", "ldir", "lx", "dir", "mkdir", "rmdir", "rm", "cp",
    "mv", "cat", "more", "less", "man", "pwd", "pushd", "popd", "dirs", "env", "set_env", "matplotlib", "pylab", "load_ext",
    "reload_ext", "unload_ext", "autoreload", "config", "precision", "who", "whos", "who_ls", "time", "timeit", "run", "prun",
    "reset", "reset_selective", "history", "hist", "store", "debug", "pdb", "pinfo", "psearch", "pprint", "xmode", "colors",
    "automagic", "alias", "logstart", "logstop", "logon", "logoff", "save", "recall", "rerun", "system", "sx", "sc", "magic",
    "lsmagic", "quickref", "clear", "gui", "page", "pycat", "tb", "notebook", "connect_info", "qtconsole",
))  # fmt: skip
"""Magics and aliases that IPython takes without their `%`, in a cell of one line."""

AUTOMAGIC = re.compile(r"\s*([a-z_]+)((?:\s+(?![=+*/<>&|^@%,.(\[-]).*|\s+--?\w.*)?)\s*")
LEADING_BLANK_LINES = re.compile(r"(?:[^\S\n]*\n)*")
TIMEIT_OPTION = re.compile(r"\s*-(?:[nrp]\s*\d+|v\s*(?P<name>\w+)|(?P<flags>[tcqo]+))(?=\s|$)")
OTHER_OPTION = re.compile(r"\s*-(?:[lsTD]\s*\S+|[rq]|-[\w-]+)(?=\s|$)")  # of %time and %prun


class Nothing:
    """Whatever else a cell asks of the shell: it can be called, looked into and assigned to, and nothing happens."""

    def __getattr__(self, name: str) -> Nothing:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __call__(self, *_args: Any, **_kwargs: Any) -> None:
        return None

    def __getitem__(self, _key: Any) -> Nothing:
        return self

    def __setitem__(self, _key: Any, _value: Any) -> None:
        pass

    def __iter__(self):
        return iter(())

    def __contains__(self, _value: Any) -> bool:
        return False

    def __bool__(self) -> bool:
        return False


class Shell:
    """What `get_ipython()` is in a cell, and what runs cells, all in one namespace."""

    def __init__(self, namespace: dict[str, Any]) -> None:
        self.user_ns = self.user_global_ns = namespace
        self.config: dict[str, Any] = {}
        self.kernel = None
        self.colors = "linux"  # which a debugger asks for
        self._magics: dict[tuple[str, str], Callable] = {}
        self._futures = 0
        self._only_definitions = False
        self._wanted: Collection[str] | None = None  # the names whose definitions run; None for all
        self._loop: Any = None
        self._home = Path.cwd()
        self._history: list[Any] = [""] * 3

    def __getattr__(self, name: str) -> Nothing:
        if name.startswith("_"):
            raise AttributeError(name)
        return Nothing()

    # ---------------------------------------------------------------------------- cells

    def cell(self, source: str, filename: str) -> None:
        """Run a cell. Of what fails in it, the first comes through when all of it has run."""
        number = _appended(self.user_ns.setdefault("In", [""]), source)
        if (value := self.run(source, filename)) is not None:
            self._remember(number, value)

    def _remember(self, number: int, value: Any) -> None:
        """What a cell ends with is `_`, `_3` and `Out[3]`, unless the notebook has a `_` of its own."""
        if self.user_ns.get("_", "") is self._history[0]:
            self._history = [value, *self._history[:2]]
            self.user_ns.update(zip(("_", "__", "___"), self._history, strict=True))
        self.user_ns[f"_{number}"] = value
        if isinstance(outputs := self.user_ns.setdefault("Out", {}), dict):
            outputs[number] = value

    def run(self, source: str, filename: str, above: int = 0) -> Any:
        """Run a cell, or the body of one whose magic takes the first `above` lines. Returns what its last expression gives.

        Raises: what the first statement raises that fails, when all the others have run.
        """
        source, tree = self._read("\n" * above + self._without_automagic(source), filename)
        linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)  # for inspect.getsource
        if self._only_definitions:
            return self._run_definitions(tree, filename)
        value, failure, awaits = None, None, _needs_a_loop(tree.body)
        for statement in _apart(tree.body):
            if isinstance(failure, SystemExit) and not _defines(statement):
                continue  # the cell was to end there: what stands below is not carried out, but is defined
            try:
                value = self._carry_out(statement, filename, awaits)
            except (Exception, SystemExit) as error:
                value, failure = None, failure or error
        if failure is not None:
            raise failure
        return value

    def _read(self, source: str, filename: str) -> tuple[str, ast.Module]:
        """The Python that is meant, and its statements. Raises: SyntaxError, of the cell as IPython reads it."""
        flags = self._futures | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT | ast.PyCF_ONLY_AST

        def parsed(text: str) -> ast.Module | None:
            try:
                return compile(text, filename, "exec", flags, dont_inherit=True)
            except SyntaxError:
                return None

        if tree := parsed(source):
            return source, tree
        python = translated(source)
        if tree := parsed(python):
            return python, tree
        if (plain := with_plain_spaces(source)) != source:
            for text in (plain, translated(plain)):
                if tree := parsed(text):
                    return text, tree
        compile(python, filename, "exec", flags, dont_inherit=True)
        raise AssertionError("it compiles now")

    def _without_automagic(self, source: str) -> str:
        found = AUTOMAGIC.fullmatch(source) if "\n" not in source.strip() else None
        if not found or found[1] not in AUTOMAGICS or found[1] in self.user_ns:
            return source
        return f"%{source.strip()}"

    def _carry_out(self, statement: ast.stmt, filename: str, in_loop: bool = False) -> Any:
        """Run one statement, in the event loop if it is to; of an expression, the value."""
        flags = self._futures | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        if isinstance(statement, ast.Expr):
            code = compile(ast.Expression(statement.value), filename, "eval", flags, dont_inherit=True)
        else:
            code = compile(ast.Module([statement], []), filename, "exec", flags, dont_inherit=True)
        self._futures |= code.co_flags & FUTURES
        if in_loop and not code.co_flags & inspect.CO_COROUTINE:
            return self._awaited(_as_coroutine(code, self.user_ns))
        return self._evaluate(code, self.user_ns, self.user_ns)

    def run_definitions(self, source: str, filename: str, wanted: Collection[str] | None = None) -> None:
        """Of a cell that can't be run as a whole, run what defines something (one of the names `wanted`) and calls nothing."""
        self._only_definitions, self._wanted = True, wanted
        try:
            self.run(source, filename)
        finally:
            self._only_definitions = False

    def _run_definitions(self, tree: ast.Module, filename: str) -> None:
        for statement in _apart(tree.body):
            wanted = self._wanted is None or names.set_by([statement]) & set(self._wanted)
            if _is_call_of_cell_magic(statement) or (wanted and _defines(statement)):
                try:
                    self._carry_out(statement, filename)
                except Exception:  # it needs what was left out
                    continue

    def statements(self, source: str) -> list[ast.stmt]:
        """What a cell consists of, with the body of a cell magic; nothing, if it can't be read."""
        try:
            found = self._read(source, "")[1].body
        except Exception:
            return []
        for call in [one.value for one in found if isinstance(one, ast.Expr) and _is_call_of_cell_magic(one)]:
            magic, _, body = (ast.literal_eval(argument) for argument in call.args)  # type: ignore[attr-defined]
            found = [*found, *(self.statements(body) if magic not in ELSEWHERE else ())]
        return found

    def _evaluate(self, code: types.CodeType, globals_: dict[str, Any], locals_: Any) -> Any:
        value = eval(code, globals_, locals_)
        return self._awaited(value) if code.co_flags & inspect.CO_COROUTINE else value

    def _awaited(self, coroutine: Any) -> Any:
        """The value of what a cell awaits, in one event loop for all cells."""
        import asyncio

        self._loop = self._loop or asyncio.new_event_loop()
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return self._loop.run_until_complete(coroutine)
        from concurrent.futures import ThreadPoolExecutor  # within a kernel, whose own loop runs in this thread

        with ThreadPoolExecutor(1) as pool:
            return pool.submit(self._loop.run_until_complete, coroutine).result()

    # ---------------------------------------------------------------------------- what transformed cells call

    def system(self, _command: str) -> None:
        self.user_ns["_exit_code"] = 0

    def getoutput(self, _command: str, split: bool = True, **_options: Any) -> Any:
        from IPython.utils.text import SList

        return SList() if split else ""

    def run_line_magic(self, name: str, line: str = "", _stack_depth: int = 1) -> Any:
        return self._line_magic(name, line, sys._getframe(1))

    def magic(self, text: str) -> Any:
        """The name of run_line_magic in old notebooks."""
        name, _, line = text.lstrip("% ").partition(" ")
        return self._line_magic(name, line, sys._getframe(1))

    def run_cell_magic(self, name: str, line: str, cell: str) -> Any:
        caller = sys._getframe(1)
        filename, above = caller.f_code.co_filename, caller.f_lineno
        if own := self._magics.get(("cell", name)):
            return None if self._only_definitions else own(line, cell)
        if name in ("writefile", "file"):
            return _write_file(self._expanded(line, caller), cell)
        if name in ELSEWHERE:
            return None
        if name == "timeit":
            return self._timed(line, caller, lambda: self.run(cell, filename, above))
        if name == "capture":
            return self._captured(line, lambda: self.run(cell, filename, above))
        if name in ("time", "prun") or _is_python(cell):
            return self.run(cell, filename, above)
        return None

    def register_magic_function(self, function: Callable, magic_kind: str = "line", magic_name: str | None = None) -> None:
        kinds = ("line", "cell") if magic_kind == "line_cell" else (magic_kind,)
        self._magics |= {(kind, magic_name or function.__name__): function for kind in kinds}

    def run_cell(self, source: str, *_args: Any, **_kwargs: Any) -> None:
        self.run(source, "<run_cell>")

    def ex(self, statement: str) -> None:
        exec(statement, self.user_ns)

    def ev(self, expression: str) -> Any:
        return eval(expression, self.user_ns)

    def push(self, variables: Any, interactive: bool = True) -> None:
        if isinstance(variables, dict):
            self.user_ns.update(variables)

    # ---------------------------------------------------------------------------- magics

    def _line_magic(self, name: str, line: str, caller: types.FrameType) -> Any:
        if own := self._magics.get(("line", name)):
            return own(line)
        if name == "time":
            return self._value(_without_options(line), caller)
        if name == "prun":
            self._value(_without_options(line), caller)
        if name == "timeit":
            return self._timed(line, caller)
        if name == "run":
            return self._run_file(self._expanded(line, caller))
        if name in ("sx", "system", "!"):
            return self.getoutput(line)
        if name == "pwd":
            return os.getcwd()
        if name == "cd":
            return self._go_to(self._expanded(line, caller))
        if name in ("env", "set_env"):
            return _environment(self._expanded(line, caller))
        if name == "pylab":
            from IPython.core.pylabtools import import_pylab

            import_pylab(self.user_ns)
        return None

    def _value(self, statement: str, caller: types.FrameType) -> Any:
        """The value of a timed expression, where the magic stands; a statement is run and has none."""
        source, filename = "\n" * (caller.f_lineno - 1) + translated(statement).strip(), caller.f_code.co_filename
        flags = self._futures | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        try:
            code = compile(source, filename, "eval", flags, dont_inherit=True)
        except SyntaxError:
            code = compile(source, filename, "exec", flags, dont_inherit=True)
        return self._evaluate(code, caller.f_globals, caller.f_locals)

    def _timed(self, line: str, caller: types.FrameType, body: Callable[[], None] | None = None) -> Any:
        """Run once what is timed: the line, or a body whose set-up the line is."""
        before, flags, name = dict(self.user_ns), "", None
        while found := TIMEIT_OPTION.match(line):
            flags, name, line = flags + (found["flags"] or ""), found["name"] or name, line[found.end() :]
        try:
            if body is not None and line.strip():
                self._value(line, caller)
            start = time.perf_counter()
            if body is not None:
                body()
            else:
                self._value(line, caller)
            took = time.perf_counter() - start
        finally:
            self.user_ns.update(before)
        if "o" not in flags and name is None:
            return None
        from IPython.core.magics.execution import TimeitResult

        result = TimeitResult(1, 1, took, took, [took], 0.0, 3)
        if name is not None:
            self.user_ns[name] = result
        return result

    def _captured(self, line: str, body: Callable[[], None]) -> None:
        from IPython.utils.capture import capture_output

        name = next((word for word in line.split() if not word.startswith("-")), None)
        with capture_output(display=False) as captured:
            try:
                body()
            finally:
                if name is not None:
                    self.user_ns[name] = captured

    def _run_file(self, line: str) -> None:
        """`%run FILE.py`, `%run NOTEBOOK.ipynb`, `%run -m MODULE`: what they define is here afterwards."""
        words = shlex.split(line)
        options = []
        while words and words[0].startswith("-"):
            options.append(words.pop(0))
        if not words:
            return
        names: dict[str, Any] = {}
        arguments, sys.argv = sys.argv, words
        try:
            if "-m" in options:
                names = runpy.run_module(words[0], run_name="__main__")
            elif (path := _existing(words[0])).suffix in (".ipynb", ".ipy"):
                for number, source in enumerate(_sources(path), start=1):
                    self.run(source, f"<{path.name}, cell {number}>")
            else:
                names = {"__name__": path.stem if "-n" in options else "__main__", "__file__": str(path)}
                space = self.user_ns if "-i" in options else names
                exec(compile(path.read_text(encoding="utf-8"), str(path), "exec", dont_inherit=True), space)
        except SystemExit:
            pass
        finally:
            sys.argv = arguments
            self.user_ns.update({name: value for name, value in names.items() if not name.startswith("__")})

    def _go_to(self, line: str) -> None:
        """`%cd FOLDER`, below the notebook's own; to others, which are not here, the cell stays where it is."""
        words = [word for word in shlex.split(line) if word not in ("-q", "--")]
        path = (Path.cwd() / (words[0] if words else self._home)).resolve()
        if path.is_dir() and path.is_relative_to(self._home.resolve()):
            os.chdir(path)

    def _expanded(self, text: str, caller: types.FrameType) -> str:
        """The line of a magic with `{expressions}` and `$names` put in."""
        from IPython.utils.text import DollarFormatter

        try:
            return DollarFormatter().vformat(text, [], {**caller.f_globals, **caller.f_locals})
        except Exception:
            return text


def shell_of(namespace: dict[str, Any]) -> Shell:
    """The namespace's shell; a learner may have cleared it away."""
    shell = namespace.get(NAME)
    if not isinstance(shell, Shell):
        namespace[NAME] = shell = Shell(namespace)
    return shell


def install(namespace: dict[str, Any]) -> None:
    """Give the namespace a shell, as `get_ipython()` there and in IPython, unless a real one runs; IPython is not imported for it."""
    shell = shell_of(namespace)
    namespace["get_ipython"] = lambda: shell
    namespace |= {"_": "", "__": "", "___": "", "In": [""], "Out": {}, "exit": _stay, "quit": _stay, "input": _nobody_answers}
    namespace |= {"_ih": namespace["In"], "_oh": namespace["Out"], "_dh": [os.getcwd()]}
    module = sys.modules.setdefault("IPython.core.getipython", types.ModuleType("IPython.core.getipython"))
    if not hasattr(module, "get_ipython") or module.get_ipython() is None:
        module.__dict__["get_ipython"] = _current


def _stay(*_arguments: Any) -> None:
    """`exit` and `quit` in a cell end a kernel, which there is none of."""


def _nobody_answers(*_arguments: Any) -> str:
    raise EOFError(
        "input() waits for somebody to type, and nobody does when a notebook is checked or graded: write the value in the cell"
    )


def without_debuggers() -> None:
    """From now on in this process, `breakpoint()` and `set_trace()` do nothing: nobody is there to debug."""
    import bdb

    def nothing(*_arguments: Any, **_options: Any) -> None:
        return None

    sys.breakpointhook = nothing
    bdb.Bdb.set_trace = nothing  # type: ignore[assignment,method-assign]


def _current() -> Any:
    return getattr(sys.modules.get("__main__"), NAME, None)


def translated(source: str) -> str:
    """The Python that IPython makes of a cell, each line where it was."""
    above = LEADING_BLANK_LINES.match(source)
    assert above is not None  # it matches nothing, too
    return "\n" * above.group().count("\n") + _transformer().transform_cell(source[above.end() :])


@functools.cache
def _transformer() -> Any:
    from IPython.core.inputtransformer2 import TransformerManager  # a tenth of a second, which plain Python need not cost

    class LineByLine(TransformerManager):
        """A command that goes on over several lines becomes one: empty lines take the place of the others."""

        def do_one_token_transform(self, lines):
            changed, new = super().do_one_token_transform(lines)
            if lost := len(lines) - len(new):
                at = next(i for i, (old, line) in enumerate(zip(lines, new, strict=False)) if old != line)
                new = new[: at + 1] + ["\n"] * lost + new[at + 1 :]
            return changed, new

    return LineByLine()


LOOP = frozenset(("create_task", "ensure_future", "get_running_loop", "TaskGroup"))
"""What asks for a running event loop, as a kernel has one."""


def _needs_a_loop(statements: list[ast.stmt]) -> bool:
    """Whether a cell awaits something, or begins what is awaited later."""
    return any(
        isinstance(node, ast.Await | ast.AsyncFor | ast.AsyncWith) or getattr(node, "attr", getattr(node, "id", "")) in LOOP
        for node in names.at_this_level(statements)
    )


async def _as_coroutine(code: types.CodeType, namespace: dict[str, Any]) -> Any:
    return eval(code, namespace)


def _apart(statements: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements, an import of several names made one for each: they succeed or fail by themselves."""
    for statement in statements:
        if isinstance(statement, ast.Import) and len(statement.names) > 1:
            yield from (ast.copy_location(ast.Import([alias]), statement) for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom) and len(statement.names) > 1:
            module, level = statement.module, statement.level
            yield from (ast.copy_location(ast.ImportFrom(module, [alias], level), statement) for alias in statement.names)
        else:
            yield statement


def _appended(history: Any, source: str) -> int:
    """The number of a cell, which goes to the end of `In`; a learner may have made that anything."""
    if not isinstance(history, list):
        return 0
    history.append(source)
    return len(history) - 1


def _is_python(source: str) -> bool:
    try:
        translation = translated(source)
        compile(translation, "", "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT | ast.PyCF_ONLY_AST, dont_inherit=True)
    except SyntaxError:
        return False
    return True


def _defines(statement: ast.stmt) -> bool:
    """Whether it is an import, a function, a class or an assignment that calls nothing."""
    if isinstance(statement, ast.Assign | ast.AnnAssign):
        return not any(isinstance(node, ast.Call | ast.Await | ast.Yield) for node in _at_once(statement))
    return isinstance(statement, ast.Import | ast.ImportFrom | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)


def _at_once(node: ast.AST):
    """All nodes but those in a lambda's body, which are for later."""
    yield node
    if not isinstance(node, ast.Lambda):
        for child in ast.iter_child_nodes(node):
            yield from _at_once(child)


def _is_call_of_cell_magic(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Call)
        and ast.unparse(statement.value.func) == "get_ipython().run_cell_magic"
    )


def _without_options(line: str) -> str:
    while found := OTHER_OPTION.match(line):
        line = line[found.end() :]
    return line


def _environment(line: str) -> Any:
    """`%env`, `%env NAME`, `%env NAME=VALUE` and `%env NAME VALUE`."""
    name, sign, value = line.strip().partition("=" if "=" in line else " ")
    if not name:
        return dict(os.environ)
    if not sign:
        return os.environ.get(name)
    os.environ[name.strip()] = value.strip()
    return None


def _existing(name: str) -> Path:
    path = Path(name).expanduser()
    return path if path.exists() or path.suffix in (".py", ".ipynb", ".ipy") else Path(f"{path}.py")


def _sources(path: Path) -> list[str]:
    from course_lib.checks.notebook import code_cells

    return [cell["source"] for cell in code_cells(path)] if path.suffix == ".ipynb" else [path.read_text(encoding="utf-8")]


def _write_file(line: str, content: str) -> None:
    """`%%writefile [-a] NAME`: below the working directory, and nowhere else."""
    *options, name = shlex.split(line)
    root = Path.cwd().resolve()
    path = (root / Path(name).expanduser()).resolve()
    if not path.is_relative_to(root):
        raise ValueError(f"%%writefile {name}: only files below the working directory are written here")
    if {"-a", "--append"} & set(options) and path.exists():
        content = path.read_text(encoding="utf-8") + content
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # one that was handed in may be read-only
    path.write_text(content, encoding="utf-8")
    importlib.invalidate_caches()
