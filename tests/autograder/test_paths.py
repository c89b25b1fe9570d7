import pytest

from autograder import paths


def test_the_root_is_the_checkout_and_a_missing_checkout_is_explained(tmp_path):
    assert (paths.ROOT / "autograder" / "paths.py").is_file()
    with pytest.raises(FileNotFoundError, match="need a checkout"):
        paths.checkout(tmp_path)
    (tmp_path / "chapters").mkdir()
    assert paths.checkout(tmp_path) == tmp_path
