import os
from pathlib import Path

from autograder.grading import sources


def test_the_folders_are_remembered_once_each_the_last_one_last(tmp_path):
    assert sources.read(tmp_path / "grades") == []
    odd = tmp_path / os.fsdecode(b"odd \xff\nname")
    for folder in (tmp_path / "a", odd, tmp_path / "a" / ".." / "a"):
        sources.remember(tmp_path / "grades", Path(folder))
    assert sources.read(tmp_path / "grades") == [odd, tmp_path / "a"]
