import dataclasses
import json
import os
import re
import subprocess
import sys
import zipfile

import nbformat
import pytest
from packaging.utils import canonicalize_name
from packaging.version import Version

from autograder.authoring.chapter import load, page_files
from autograder.authoring.contract import references, sources
from autograder.publishing import release
from course_lib.checks import packages


def _release(tiny, out, only=None, **options):
    return release.release(out, only, directory=tiny.directory, sources=tiny.sources, **options)


def _files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _readable(folder):
    """All files, with the contents of archives (the zip, the frozen checks) unpacked."""
    files = _files(folder)
    for name in [name for name in files if name.endswith((".zip", ".npz"))]:
        with zipfile.ZipFile(folder / name) as archive:
            inside = {f"{name}/{member}": archive.read(member) for member in archive.namelist()}
        files |= {
            member: content.replace(b"\0", b"") for member, content in inside.items()
        }  # NumPy's text has four bytes a letter
    return files


@pytest.fixture(scope="module")
def bundle(tiny, tmp_path_factory):
    return _release(
        tiny, tmp_path_factory.mktemp("bundle"), recorded=lambda chapter: tiny.outputs if chapter.number == 99 else []
    )


def test_a_bundle_has_notebooks_library_frozen_checks_and_a_readme(bundle):
    files = _files(bundle)
    assert {"ch98/ch98.ipynb", "ch99/ch99.ipynb", "README.md", "course.zip", ".release.json"} <= files.keys()
    assert {"course_lib/pyproject.toml", "course_lib/course_lib/validate.py"} <= files.keys()
    frozen = {name for name in files if "/frozen/" in name}
    assert frozen == {f"course_lib/course_lib/frozen/{name}" for name in ("double.npz", "quadruple.npz", "ch99.cells")}
    assert b"`ch99/ch99.ipynb`: A tiny chapter: twice (90 minutes)" in files["README.md"]
    assert packages.listed().encode() in files["README.md"]
    assert b"attachment:ch99-007-1.png" in files["ch99/ch99.ipynb"]


def test_two_releases_are_the_same_bytes(tiny, bundle, tmp_path):
    again = _release(tiny, tmp_path, recorded=lambda chapter: tiny.outputs if chapter.number == 99 else [])
    assert _files(again) == _files(bundle)


def test_the_zip_holds_the_bundle(bundle):
    with zipfile.ZipFile(bundle / "course.zip") as archive:
        inside = {name: archive.read(name) for name in archive.namelist()}
    assert inside == {name: content for name, content in _files(bundle).items() if name not in ("course.zip", ".release.json")}


def test_only_some_chapters_are_released_with_their_checks_alone(tiny, tmp_path):
    files = _files(_release(tiny, tmp_path, ["ch98"]))
    assert "ch98/ch98.ipynb" in files and not [name for name in files if "ch99" in name or "/frozen/" in name]


def test_a_later_release_of_another_chapter_keeps_the_checks_of_the_first_in_the_folder(tiny, tmp_path):
    _release(tiny, tmp_path, ["ch99"])
    assert "course_lib/course_lib/frozen/double.npz" in _files(_release(tiny, tmp_path, ["ch98"]))
    with zipfile.ZipFile(tmp_path / "course.zip") as archive:
        assert not [name for name in archive.namelist() if "/frozen/" in name]


def test_records_of_long_runs_are_put_beside_the_library_but_no_policies(tiny, tmp_path, monkeypatch):
    from autograder import paths
    from autograder.authoring import chapter
    from course_lib.figures import records

    monkeypatch.setattr(paths, "RUNS", tmp_path / "runs")
    page = dataclasses.replace(chapter.load("ch98", tiny.directory), experiments=("toy",))
    monkeypatch.setattr(release, "_chosen", lambda only, directory: [page])
    with pytest.raises(ValueError, match=r"no records of the experiment 'toy' .*`course experiment toy` makes them"):
        _release(tiny, tmp_path / "bundle")
    made = {"variant": "a", "seed": 0, "configuration": {}, "summary": {}}
    records.write(tmp_path / "runs" / "toy" / "a-0.parquet", [{"env_steps": 0, "score": 4.0}], made)
    for name in ("a-0.safetensors", "a-0.mp4", ".writing-x.mp4"):
        (tmp_path / "runs" / "toy" / name).write_bytes(b"content")
    bundle = _release(tiny, tmp_path / "bundle")
    library = bundle / "course_lib" / "course_lib"
    assert {path.name for path in (library / "runs" / "toy").iterdir()} == {"a-0.parquet", "a-0.mp4"}
    program = "from course_lib.figures import records; print(records.load('toy').final('a', 'score'))"
    environment = {**os.environ, "PYTHONPATH": str(library.parent)}
    shown = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert shown.stdout == "[4.]\n"


def test_an_unknown_chapter_is_refused_before_anything_is_written(tiny, tmp_path):
    with pytest.raises(ValueError, match="no chapter 'ch12'; there are: ch98, ch99"):
        _release(tiny, tmp_path / "out", ["ch98", "ch12"])
    assert not (tmp_path / "out").exists()


def test_a_learners_work_is_never_overwritten(tiny, tmp_path):
    said = []
    notebook, new = tmp_path / "ch99" / "ch99.ipynb", tmp_path / "ch99" / "ch99.new.ipynb"
    fresh = _release(tiny, tmp_path, ["ch99"], say=said.append).joinpath("ch99/ch99.ipynb").read_bytes()
    notebook.write_text("my work")
    _release(tiny, tmp_path, ["ch99"], say=said.append)
    assert notebook.read_text() == "my work" and new.read_bytes() == fresh
    assert len(said) == 1 and str(notebook) in said[0] and str(new) in said[0]
    with zipfile.ZipFile(tmp_path / "course.zip") as archive:
        assert archive.read("ch99/ch99.ipynb") == fresh
    new.write_text("my work, continued")
    _release(tiny, tmp_path, ["ch99"], say=said.append)
    assert new.read_text() == "my work, continued" and new.with_name("ch99.new2.ipynb").read_bytes() == fresh


def test_a_notebook_that_an_earlier_release_wrote_is_brought_up_to_date(tiny, tmp_path):
    _release(tiny, tmp_path, ["ch99"])
    first = (tmp_path / "ch99" / "ch99.ipynb").read_bytes()
    _release(tiny, tmp_path, ["ch99"], recorded=lambda chapter: tiny.outputs, say=pytest.fail)
    assert (tmp_path / "ch99" / "ch99.ipynb").read_bytes() != first and not list(tmp_path.rglob("*.new.ipynb"))


def test_an_interrupted_release_does_not_take_its_own_notebook_for_a_learners(tiny, tmp_path, monkeypatch):
    write = release._write

    def interrupted(path, content):
        write(path, content)
        if path.suffix == ".ipynb":
            raise KeyboardInterrupt

    monkeypatch.setattr(release, "_write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _release(tiny, tmp_path, ["ch99"])
    monkeypatch.undo()
    _release(tiny, tmp_path, ["ch99"], recorded=lambda chapter: tiny.outputs, say=pytest.fail)
    assert not list(tmp_path.rglob("*.new.ipynb")) and not list(tmp_path.rglob(".writing-*"))


def test_modules_that_the_library_no_longer_has_are_removed_but_nobody_elses_files(tiny, tmp_path):
    manifest = _release(tiny, tmp_path, ["ch98"]) / ".release.json"
    gone, theirs = tmp_path / "course_lib" / "course_lib" / "gone.py", tmp_path / "course_lib" / "theirs.py"
    gone.write_text("")
    theirs.write_text("")
    state = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**state, "library": [*state["library"], "course_lib/course_lib/gone.py"]}))
    _release(tiny, tmp_path, ["ch98"])
    assert not gone.exists() and theirs.exists()


def test_the_library_installs_with_its_frozen_checks_and_without_the_project(bundle, tmp_path):
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target", str(tmp_path)]
    subprocess.run([*pip, str(bundle / "course_lib")], check=True, capture_output=True)
    code = "import course_lib.checks.client as c; print(c.__file__, c.exercise_names())"
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == f"{tmp_path}/course_lib/checks/client.py ['double', 'quadruple']"
    metadata = next(tmp_path.glob("course_lib-*.dist-info/METADATA")).read_text()
    required = re.findall(r"Requires-Dist: ([\w-]+)>=(\S+?)(; extra == .flight.)?$", metadata, re.MULTILINE)
    assert {name: version for name, version, extra in required if not extra} == release.LEARNERS_NEED
    assert {name: version for name, version, extra in required if extra} == release.FLIGHT_NEEDS


def test_the_pins_are_no_older_than_what_learners_need():
    lists = "\n".join((release.paths.ROOT / name).read_text() for name in ("requirements.txt", "constraints.txt"))
    pins = {canonicalize_name(name): version for name, version in re.findall(r"^([\w-]+)(?:\[.*\])?==(\S+)", lists, re.MULTILINE)}
    for name, oldest in (release.LEARNERS_NEED | release.FLIGHT_NEEDS).items():
        assert Version(pins[canonicalize_name(name)]) >= Version(oldest), name


def test_no_line_of_a_tiny_solution_and_no_name_of_the_judge_is_in_the_bundle(bundle):
    for name, content in _readable(bundle).items():
        for secret in (b"total = x + x", b"for _ in range(times)", b"tiny_solutions", b"autograder"):
            assert secret not in content, name


@pytest.fixture(scope="module")
def real(tmp_path_factory, request):
    """The real bundle, readable; with --only, that of one chapter."""
    only = request.config.getoption("--only")
    return _readable(release.release(tmp_path_factory.mktemp("real"), [only] if only else None))


@pytest.mark.parametrize("assignment", [f"ch{number}" for number in page_files()])
def test_no_line_of_a_real_solution_or_check_is_in_the_real_bundle(real, assignment):
    numbers = (".safetensors", ".parquet", ".mp4", ".webp", ".zip", ".npz")  # what is in an archive is here one by one
    everything = b"\n".join({content for name, content in real.items() if not name.endswith(numbers)})
    library = "\n".join(path.read_text(encoding="utf-8") for path in release.paths.COURSE_LIB.rglob("*.py"))
    chapter = load(assignment)
    found = sources(chapter)
    bodies = [reference.body for reference in references(chapter, found).values()]
    checks = (release.paths.ROOT / "autograder" / "checks" / f"{chapter.assignment}.py").read_text(encoding="utf-8")
    lines = {line.strip() for line in "\n".join([*bodies, checks]).splitlines()}
    ordinary = ("from ", "import ", '"')  # lines of text alone are messages, which learners read
    meant = chapter.path.read_text(encoding="utf-8") + library  # a hint that quotes a line, a helper that has it, too
    telling = {line for line in lines if len(line) > 30 and line not in meant and not line.startswith(ordinary)}
    told = {line for line in {*telling, f"solutions.{chapter.assignment}"} if line.encode() in everything}
    assert not {(line, name) for line in told for name, content in real.items() if line.encode() in content}


def test_nbgraders_course_has_every_chapter_and_a_configuration(tiny, tmp_path):
    release.write_nbgrader_course(tmp_path, chapters=tiny.directory, sources=tiny.sources)
    assert _files(tmp_path).keys() == {"source/ch98/ch98.ipynb", "source/ch99/ch99.ipynb", "nbgrader_config.py"}
    nbformat.validate(nbformat.read(tmp_path / "source" / "ch99" / "ch99.ipynb", as_version=4))
