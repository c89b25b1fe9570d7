"""A new chapter's files keep the format, overwrite nothing, and stubs are made from solutions."""

import pytest

from autograder import paths
from autograder.authoring import assemble, chapter, contract, skeleton

NAMES = ["soft_values", "boltzmann_policy"]


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """The files of a new chapter 46, in a folder of their own, and its parsed page."""
    monkeypatch.setattr(paths, "ROOT", tmp_path)
    files = skeleton.write(46, "Maximum entropy RL", NAMES, tmp_path)
    return files, chapter.load(46, tmp_path / "chapters")


def test_a_skeleton_is_named_as_a_chapter_is_and_its_page_can_be_read(begun):
    files, page = begun
    assert [file.name for file in files] == ["ch46.py", "ch46.py", "ch46_maximum_entropy_rl.md", "test_ch46.py"]
    assert page.title == "Maximum entropy RL" and [cell.exercise for cell in page.exercises] == NAMES
    for file in files:
        assert "TODO" in file.read_text()
        if file.suffix == ".py":
            compile(file.read_text(), str(file), "exec")


def test_an_empty_stub_has_signature_and_docstring_of_its_reference(begun):
    _, page = begun
    for cell in page.exercises:
        found = contract._function(cell.source)
        assert found.node.name == cell.exercise and found.reference.body.strip() == contract.STUB
        assert "Returns: (B,) TODO." in found.reference.docstring


def test_an_empty_stub_without_a_reference_is_refused_by_file_and_line(begun, tmp_path):
    (tmp_path / "solutions" / "ch46.py").write_text("")
    with pytest.raises(
        chapter.ChapterError, match=r"ch46_maximum_entropy_rl\.md:\d+: the stub is empty.*no function soft_values"
    ):
        chapter.load(46, tmp_path / "chapters")


def test_a_skeletons_page_renders_in_all_views(begun, monkeypatch):
    import importlib.util
    import sys

    files, page = begun
    for name, path in (("solutions.ch46", files[0]), ("autograder.checks.ch46", files[1])):
        spec = importlib.util.spec_from_file_location(name, path)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        if name == "solutions.ch46":
            import solutions

            monkeypatch.setattr(solutions, "ch46", module, raising=False)
        spec.loader.exec_module(module)
    real = sys.modules
    sources = contract.Sources(
        real["autograder.checks.ch46"].EXERCISES, real["solutions.ch46"], paths.BIBLIOGRAPHY, {46: page.page}
    )
    assemble.verify(page, sources)


def test_nothing_is_overwritten(begun, tmp_path):
    files, _ = begun
    before = [file.read_text() for file in files]
    files[2].rename(files[2].with_name("ch47_other.md"))
    with pytest.raises(ValueError, match=r"solutions/ch46\.py exists"):
        skeleton.write(46, "Another title", ["one"], tmp_path)
    assert files[0].read_text() == before[0] and not list(tmp_path.glob("chapters/ch46_*"))


@pytest.mark.parametrize("names", [["1x"], ["a b"], ["a", "a"], []])
def test_names_that_are_none_are_refused(names, tmp_path):
    with pytest.raises(ValueError):
        skeleton.write(46, "T", names, tmp_path)
    assert not list(tmp_path.iterdir())
