"""What Python code rests on what, read from the source alone: nothing that is read here is ever imported.

The unit is a top-level statement of one of the project's modules: a function, a class, an assignment. `Code.reach` follows from one to
those that it needs, and the fingerprint of what was reached changes if, and (nearly) only if, something has changed that it rests on.
The rules, each in favour of reaching more where it is in doubt:

- a name stands for every top-level statement of its module that binds it, even where a local variable hides it;
- `from module import name` leads to that name's statements; of `import module` and `from package import module`, the attributes that
  are used, or the whole module where the module itself is handed about; a star import leads to the whole module;
- of every module that is imported on the way (with its packages), statements that do more than bind a name count, with what they need;
  so do functions and classes with a decorator of the project's own;
- strings are read where they stand: "module.name" with a module of course_lib (`built("seeding.generator")`), the name of a view,
  `earlier("compute_gae", chapter=44)`, and an f-string that begins with a module; whatever is computed leads to all that it may mean;
- `globals()`, `eval` and the like lead to the whole module in which they stand;
- where source or docstrings are read at run time (`inspect.getsource`, `__doc__`), the modules' texts count as they are written.

Else comments, layout and docstrings do not count, nor does the name under which a package of others is known. Out of reach are data
files (`Reached.mentions` helps to find them by name), other packages (`Reached.packages` names them, for their pins), and a
module that is changed by an assignment's hidden effect, such as a registry that a constructor fills.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

PACKAGES = ("course_lib", "solutions", "experiments", "autograder")
LIBRARY, ANSWERS, VIEWS = "course_lib", "solutions", "course_lib.checks.views"
BY_STRING = {
    "course_lib.checks.observing._given",
    "course_lib.checks.diagnosis.view",
    "course_lib.chapters._function",
    "autograder.checks.exercises",
}
"""Functions that look up what a string names: those strings are read where they stand."""
READS_ITSELF = {"getsource", "getsourcelines", "findsource", "getcomments", "getdoc", "__doc__", "help"}
READS_ALL_NAMES = {"globals", "locals", "vars", "eval", "exec"}
PAGE = "<page>"

Chain = tuple[str, ...]
Place = tuple[str, int]  # a module, and the number of a statement in it


@dataclass(frozen=True)
class _Import:
    """`import module` (no name) or `from module import name`, under an alias; "*" is its own alias."""

    module: str
    name: str
    alias: str


@dataclass
class _Statement:
    """A top-level statement; `node` is None for one name of an import statement, which is then the only entry of `imports`."""

    node: ast.stmt | None
    bound: set[str]
    imports: list[_Import]
    acts: bool = False

    @functools.cached_property
    def uses(self) -> _Uses:
        found = _Uses()
        if self.node is not None:
            found.visit(self.node)
        return found

    @functools.cached_property
    def text(self) -> str:
        return repr(self.imports) if self.node is None else ast.dump(self.node)


class _Uses(ast.NodeVisitor):
    """What a statement mentions: names with the attributes that follow, strings, imports within, and calls that look up strings."""

    def __init__(self) -> None:
        self.chains: set[Chain] = set()
        self.strings: set[str] = set()
        self.prefixes: set[str] = set()  # what an f-string begins with
        self.imports: list[_Import] = []
        self.lookups: list[tuple[str, ast.Call]] = []

    def visit_Name(self, node: ast.Name) -> None:
        self.chains.add((node.id,))

    def visit_Attribute(self, node: ast.Attribute) -> None:
        attributes, inner = [node.attr], node.value
        while isinstance(inner, ast.Attribute):
            attributes.append(inner.attr)
            inner = inner.value
        if isinstance(inner, ast.Name):
            self.chains.add((inner.id, *reversed(attributes)))
        else:
            self.chains.add(("", *reversed(attributes)))
            self.visit(inner)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str):
            self.strings.add(node.value)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        if node.values and isinstance(node.values[0], ast.Constant):
            self.prefixes.add(str(node.values[0].value))
        self.generic_visit(node)

    def visit_Global(self, node: ast.Global) -> None:
        self.chains |= {(name,) for name in node.names}

    def visit_Import(self, node: ast.Import) -> None:
        self.imports += _imports(node, "")

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        self.imports += _imports(node, "")  # one that is relative is refused at the top level, and not used within

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if called in {"built", "earlier", "import_module", "__import__"}:
            self.lookups.append((called, node))
        self.generic_visit(node)


def _imports(node: ast.Import | ast.ImportFrom, package: str) -> list[_Import]:
    if isinstance(node, ast.Import):
        return [_Import(one.name, "", one.asname or one.name.split(".")[0]) for one in node.names]
    module = node.module or ""
    if node.level:
        parents = package.split(".")
        module = ".".join([*parents[: len(parents) - node.level + 1], *([module] if module else [])])
    return [_Import(module, one.name, one.asname or one.name) for one in node.names]


class _Plain(ast.NodeTransformer):
    """Leaves out docstrings and other strings that stand alone."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            return None
        return self.generic_visit(node)

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.body:
            node.body = [ast.Pass()]
        return node


@dataclass
class _Module:
    name: str
    source: str
    statements: list[_Statement] = field(default_factory=list)
    future: list[str] = field(default_factory=list)

    @functools.cached_property
    def binding(self) -> dict[str, list[int]]:
        """The statements that bind a name."""
        found: dict[str, list[int]] = {}
        for number, statement in enumerate(self.statements):
            for name in statement.bound:
                found.setdefault(name, []).append(number)
        return found

    @functools.cached_property
    def stars(self) -> list[_Import]:
        return [one for statement in self.statements for one in statement.imports if one.name == "*"]


def _parsed(name: str, source: str, is_package: bool) -> _Module:
    module = _Module(name, source)
    package = name if is_package else name.rpartition(".")[0]
    for node in _Plain().visit(ast.parse(source)).body:
        if isinstance(node, ast.ImportFrom) and node.module == "__future__":
            module.future += [one.name for one in node.names]
        elif isinstance(node, ast.Import | ast.ImportFrom):
            module.statements += [_Statement(None, {one.alias}, [one]) for one in _imports(node, package)]
        elif isinstance(node, ast.If) and _is_for_types(node.test):
            inner = [
                one for part in node.body if isinstance(part, ast.Import | ast.ImportFrom) for one in _imports(part, package)
            ]
            module.statements += [_Statement(None, {one.alias}, [one]) for one in inner]
        elif name == PAGE or not (isinstance(node, ast.If) and _is_for_scripts(node.test)):
            module.statements.append(_statement(node, package))
    own = {name for statement in module.statements if statement.node is not None for name in statement.bound}
    own |= {one.alias for s in module.statements for one in s.imports if one.module.split(".")[0] in PACKAGES}
    for statement in module.statements:
        if isinstance(statement.node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            statement.acts = any(_root(decorator) in own for decorator in statement.node.decorator_list)
    return module


def _statement(node: ast.stmt, package: str) -> _Statement:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return _Statement(node, {node.name}, [])
    scope = _Scope(package)
    scope.visit(node)
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    inside = [part for target in targets for part in ast.walk(target)]
    acts = not targets or any(isinstance(part, ast.Attribute | ast.Subscript) for part in inside)
    return _Statement(node, scope.bound, scope.imports, acts)


class _Scope(ast.NodeVisitor):
    """What a statement binds in its module: not what its comprehensions, functions and classes bind for themselves."""

    def __init__(self, package: str) -> None:
        self.package = package
        self.bound: set[str] = set()
        self.imports: list[_Import] = []

    def visit_Name(self, node: ast.Name) -> None:
        if isinstance(node.ctx, ast.Store):
            self.bound.add(node.id)

    def visit_NamedExpr(self, node: ast.NamedExpr) -> None:
        self.bound.add(node.target.id)
        self.visit(node.value)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        self.visit(node.iter)
        for test in node.ifs:
            self.visit(test)

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        self.bound |= {node.name} - {None}  # type: ignore[arg-type]
        self.generic_visit(node)

    def _named(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> None:
        self.bound.add(node.name)

    visit_FunctionDef = visit_AsyncFunctionDef = visit_ClassDef = _named

    def visit_Lambda(self, node: ast.Lambda) -> None:
        pass

    def _imported(self, node: ast.Import | ast.ImportFrom) -> None:
        found = _imports(node, self.package)
        self.imports += found
        self.bound |= {one.alias for one in found}

    visit_Import = visit_ImportFrom = _imported


def _is_for_types(test: ast.expr) -> bool:
    return getattr(test, "id", getattr(test, "attr", "")) == "TYPE_CHECKING"


def _is_for_scripts(test: ast.expr) -> bool:
    return isinstance(test, ast.Compare) and getattr(test.left, "id", "") == "__name__"


def _root(node: ast.expr) -> str:
    while isinstance(node, ast.Attribute | ast.Call):
        node = node.value if isinstance(node, ast.Attribute) else node.func
    return getattr(node, "id", "")


@dataclass(frozen=True)
class Reached:
    """What some code rests on.

    `definitions` are the names of the statements, "module.name" (or "module:NUMBER" for one that binds none); `modules` those that are
    imported on the way, whether or not anything of them counts; `packages` the packages of others; `fingerprint` a hash of it all.
    """

    definitions: frozenset[str]
    modules: frozenset[str]
    packages: frozenset[str]
    strings: frozenset[str]
    fingerprint: str

    def mentions(self, path: Path) -> bool:
        """Whether a string of the code names this (relative) path: the file or one of its folders, with or without suffix."""
        return bool({*path.parts, path.stem} & self._words)

    @functools.cached_property
    def _words(self) -> set[str]:
        return {word for string in self.strings for word in re.split(r"[/\\]", string)}


class Code:
    """The project's Python code below `root`, as text; read once, so make a new one after a change."""

    def __init__(self, root: Path, packages: Iterable[str] = PACKAGES) -> None:
        self.root, self.packages = root, tuple(packages)
        self._modules: dict[str, _Module | None] = {}
        self._times: dict[Path, int] = {}

    def is_current(self) -> bool:
        """Whether no file that was read has been written since."""
        return all(path.is_file() and path.stat().st_mtime_ns == time for path, time in self._times.items())

    def module(self, name: str) -> _Module | None:
        """A module of the project, parsed; None if there is no such."""
        if name not in self._modules:
            path = self.root.joinpath(*name.split("."))
            files = (path / "__init__.py", path.with_name(f"{path.name}.py"))
            found = next((file for file in files if file.is_file()), None)
            known = None
            if name.split(".")[0] in self.packages:
                if found is not None:
                    self._times[found] = found.stat().st_mtime_ns
                    known = _parsed(name, found.read_text(encoding="utf-8"), found.name == "__init__.py")
                elif path.is_dir():
                    known = _Module(name, "")  # a package without __init__.py
            self._modules[name] = known
        return self._modules[name]

    def all_modules(self, package: str) -> list[str]:
        """The names of all modules of a package."""
        files = sorted((self.root / package).rglob("*.py"))
        names = [".".join(file.relative_to(self.root).with_suffix("").parts) for file in files]
        return [name.removesuffix(".__init__") for name in names]

    def reach(self, definitions: Iterable[str], cells: Iterable[str] = ()) -> Reached:
        """All that these definitions, "module" or "module:name", and the code of these cells of a page rest on.

        Raises: LookupError for a definition that is not there.
        """
        walk = _Walk(self)
        for definition in definitions:
            module, _, name = definition.partition(":")
            if self.module(module) is None or (name and not walk.define(module, name)):
                raise LookupError(f"there is no {definition} in {self.root}")
            if not name:
                walk.whole(module)
        walk.page(list(cells))
        return walk.finish()


class _Walk:
    """One search. Whatever is found is put on a list, and taken from it until nothing is left, so that circles end."""

    def __init__(self, code: Code) -> None:
        self.code = code
        self.places: set[Place] = set()
        self.waiting: list[Place] = []
        self.executed: set[str] = set()
        self.wholes: set[str] = set()
        self.followed: set[tuple[_Import, Chain]] = set()
        self.packages: set[str] = set()
        self.strings: set[str] = set()
        self.page_module: _Module | None = None
        self.cells: list[str] = []

    def _module(self, name: str) -> _Module | None:
        return self.page_module if name == PAGE else self.code.module(name)

    def page(self, cells: list[str]) -> None:
        """The cells of a page, all of them; what is not Python leads to everything that a page may import."""
        self.cells = cells
        source = "\n".join(re.sub(r"^\s*[%!].*$", "", cell, flags=re.MULTILINE) for cell in cells)
        try:
            self.page_module = _parsed(PAGE, source, is_package=False)
        except SyntaxError:
            for package in (LIBRARY, ANSWERS):
                self._all_of(package)
            return
        self._execute_imports(self.page_module)
        for number in range(len(self.page_module.statements)):
            self._add((PAGE, number))

    def finish(self) -> Reached:
        while self.waiting:
            self._visit(*self.waiting.pop())
        by_module: dict[str, list[int]] = {}
        for module, number in sorted(self.places):
            by_module.setdefault(module, []).append(number)
        as_written = any(self._reads_itself(place) for place in self.places)
        digest, names = hashlib.sha256(), set()
        for cell in self.cells:
            digest.update(hashlib.sha256(cell.encode()).digest())
        for name, numbers in by_module.items():
            found = self._module(name)
            assert found is not None
            texts = [found.source] if as_written else [found.statements[number].text for number in numbers]
            if name != PAGE:
                for text in (name, *found.future, *texts):
                    digest.update(hashlib.sha256(text.encode()).digest())
            for number in numbers:
                names |= {f"{name}.{bound}" for bound in found.statements[number].bound} or {f"{name}:{number}"}
        return Reached(
            frozenset(names),
            frozenset(self.executed),
            frozenset(self.packages),
            frozenset(self.strings),
            digest.hexdigest()[:16],
        )

    def _reads_itself(self, place: Place) -> bool:
        statement = self._module(place[0]).statements[place[1]]  # type: ignore[union-attr]
        imported = {one.name for one in (*statement.imports, *statement.uses.imports)}
        return bool(READS_ITSELF & (imported | {name for chain in statement.uses.chains for name in (chain[0], chain[-1])}))

    # ---- one step

    def _add(self, place: Place) -> None:
        if place not in self.places:
            self.places.add(place)
            self.waiting.append(place)

    def _visit(self, name: str, number: int) -> None:
        module = self._module(name)
        assert module is not None
        statement = module.statements[number]
        uses = statement.uses
        self.strings |= uses.strings
        for one in uses.imports:
            self._execute_import(one)
            self._follow(one, ())
        looks_up = f"{name}.{next(iter(statement.bound), '')}" in BY_STRING
        for chain in uses.chains:
            if not (looks_up and len(chain) == 1 and self._is_module(module, chain[0])):
                self._resolve(module, statement, chain)
        if not looks_up:
            for called, node in uses.lookups:
                self._look_up(module, called, node)
        for string in uses.strings:
            self._named(string)
        for prefix in uses.prefixes:
            if not looks_up and (library := self._begun(prefix)):
                self.whole(library)
        if {chain[0] for chain in uses.chains} & READS_ALL_NAMES and name != PAGE:
            self.whole(name)

    def _resolve(self, module: _Module, statement: _Statement, chain: Chain) -> None:
        """A name as it is used in a statement."""
        root, *rest = chain
        for one in statement.uses.imports:
            if one.alias == root:
                self._follow(one, tuple(rest), used=True)
        self._bound(module, root, tuple(rest))

    def _is_module(self, module: _Module, name: str) -> bool:
        """Whether an imported name stands for a module of the project."""
        imports = [one for number in module.binding.get(name, ()) for one in module.statements[number].imports]
        return any(self.code.module(f"{one.module}.{one.name}" if one.name else one.module) for one in imports)

    def _bound(self, module: _Module, name: str, rest: Chain) -> bool:
        """Whether a module binds a name, by itself or by a star; all that binds it is reached."""
        numbers = module.binding.get(name, [])
        for number in numbers:
            self._add((module.name, number))
            for one in module.statements[number].imports:
                if one.alias == name:
                    self._follow(one, rest, used=True)
        if not numbers:
            for star in module.stars:
                self._follow(star, ())
        return bool(numbers)

    def _follow(self, one: _Import, rest: Chain, used: bool = False) -> None:
        """What an imported name leads to, with the attributes that are used of it; a module that is not used leads nowhere."""
        if (one, rest) in self.followed and used:
            return
        if used:
            self.followed.add((one, rest))
        package = one.module.split(".")[0]
        if package not in self.code.packages:
            self.packages.add(package)
            return
        if one.name == "*":
            self.whole(one.module)
        elif not one.name:
            # `import a.b` binds a, `import a.b as c` binds a.b
            if used:
                self._attribute(package if one.alias == package else one.module, rest)
        else:
            is_module = self.code.module(f"{one.module}.{one.name}") is not None
            if is_module and used:
                self._attribute(f"{one.module}.{one.name}", rest)
            defined = self.define(one.module, one.name, rest)
            if not defined and not is_module:
                self.whole(one.module)

    def _attribute(self, name: str, rest: Chain) -> None:
        """`name.rest` of a module of the project."""
        self._execute(name)
        if rest and self.code.module(f"{name}.{rest[0]}") is not None:
            self._attribute(f"{name}.{rest[0]}", rest[1:])
            self.define(name, rest[0], rest[1:])
        elif not rest or not self.define(name, rest[0], rest[1:]):
            self.whole(name)

    def define(self, name: str, binding: str, rest: Chain = ()) -> bool:
        """Reach what binds a name in a module; whether anything does."""
        module = self.code.module(name)
        if module is None:
            return False
        self._execute(name)
        return self._bound(module, binding, rest)

    def whole(self, name: str) -> None:
        """Reach all statements of a module; what it imports and does not use is not followed, unless by name."""
        module = self._module(name)
        if module is None or name in self.wholes:
            return
        self.wholes.add(name)
        self._execute(name)
        for number, statement in enumerate(module.statements):
            self._add((name, number))
            for one in statement.imports:
                self._follow(one, ())

    def _all_of(self, package: str) -> None:
        for name in self.code.all_modules(package):
            self.whole(name)

    # ---- importing runs a module

    def _execute(self, name: str) -> None:
        if name in self.executed or name == PAGE:
            return
        module = self.code.module(name)
        if module is None:
            return
        self.executed.add(name)
        if "." in name:
            self._execute(name.rpartition(".")[0])
        self._execute_imports(module)
        for number, statement in enumerate(module.statements):
            if statement.acts:
                self._add((name, number))

    def _execute_imports(self, module: _Module) -> None:
        for statement in module.statements:
            for one in statement.imports:
                self._execute_import(one)

    def _execute_import(self, one: _Import) -> None:
        if one.module.split(".")[0] in self.code.packages:
            self._execute(one.module)
            if one.name and one.name != "*":
                self._execute(f"{one.module}.{one.name}")

    # ---- what strings name

    def _begun(self, prefix: str) -> str:
        """The module of course_lib with which an f-string begins, if any."""
        begins = re.match(r"(\w+(?:\.\w+)*)\.", prefix)
        library = f"{LIBRARY}.{begins[1]}" if begins else ""
        return library if library and self.code.module(library) else ""

    def _named(self, string: str) -> None:
        module, _, name = string.rpartition(".")
        if re.fullmatch(r"\w+(\.\w+)+", string) and self.code.module(f"{LIBRARY}.{module}"):
            self.define(f"{LIBRARY}.{module}", name)
        elif string.isidentifier() and (views := self.code.module(VIEWS)) and string in views.binding:
            self.define(VIEWS, string)

    def _look_up(self, module: _Module, called: str, node: ast.Call) -> None:
        arguments = {keyword.arg: keyword.value for keyword in node.keywords}
        first = node.args[0] if node.args else arguments.get("maker", arguments.get("name"))
        text = first.value if isinstance(first, ast.Constant) and isinstance(first.value, str) else None
        begins = first.values[0] if isinstance(first, ast.JoinedStr) and first.values else None
        prefix = begins.value if isinstance(begins, ast.Constant) and isinstance(begins.value, str) else ""
        if called == "built":
            if text is None and not self._begun(prefix):
                self._all_of(LIBRARY)
        elif called == "earlier":
            chapter = node.args[1] if len(node.args) > 1 else arguments.get("chapter")
            number = chapter.value if isinstance(chapter, ast.Constant) and isinstance(chapter.value, int) else None
            if number is None:
                self._all_of(ANSWERS)
            elif text is None or not self.define(f"{ANSWERS}.ch{number}", text):
                self.whole(f"{ANSWERS}.ch{number}")
        elif text is not None:
            self.packages.add(text.split(".")[0])
            self.whole(text)
        else:
            packages = [package for package in self.code.packages if prefix.startswith(f"{package}.")]
            for package in packages or self.code.packages:
                self._all_of(package)


def definition_of(module: str, source: str, kind: str, name: str) -> str:
    """Where a module `NAME = kind(name="…", …)` defines the exercise `name`: "module:NAME", or the whole module if that is not clear."""
    found = [
        statement.targets[0].id
        for statement in _assignments(ast.parse(source))
        if isinstance(statement.targets[0], ast.Name) and _is_called(statement.value, kind, name)
    ]
    return f"{module}:{found[0]}" if len(found) == 1 else module


def _assignments(tree: ast.Module) -> Iterator[ast.Assign]:
    return (statement for statement in tree.body if isinstance(statement, ast.Assign) and len(statement.targets) == 1)


def _is_called(value: ast.expr, kind: str, name: str) -> bool:
    if not isinstance(value, ast.Call) or kind not in (getattr(value.func, "id", ""), getattr(value.func, "attr", "")):
        return False
    given = [keyword.value for keyword in value.keywords if keyword.arg == "name"] or value.args[:1]
    return bool(given) and isinstance(given[0], ast.Constant) and given[0].value == name
