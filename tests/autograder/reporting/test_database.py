"""Which database is meant, and what is wrong with one, in a line."""

import sys
from types import SimpleNamespace

import pytest
from sqlalchemy.exc import OperationalError
from typer.testing import CliRunner

from autograder import cli
from autograder.paths import ROOT
from autograder.platforms import give_back
from autograder.reporting import database


@pytest.mark.parametrize("kind", ["postgresql", "postgres", "postgresql+psycopg"])
def test_every_way_of_writing_postgresql_means_psycopg_three(kind):
    assert database.address(f"{kind}://me@host/course").drivername == "postgresql+psycopg"


def test_sqlite_stays_as_it_is():
    assert str(database.address("sqlite:///grades/gradebook.db")) == "sqlite:///grades/gradebook.db"


@pytest.mark.parametrize(
    ("db_url", "says"),
    [
        ("secret", "is not the address of a database"),
        ("postgresql://me:secret@host:port/course", "is not the address of a database"),
        ("oracular://me:secret@host/course", "no kind of database is called 'oracular'"),
        ("postgresql://me:secret@host/course", "pip install 'psycopg[binary]==3.3.9'"),
    ],
)
def test_an_address_that_cannot_be_used_is_a_line_without_its_password(db_url, says, monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(database.UnusableURL) as refused:
        database.engine(db_url)
    assert says in str(refused.value) and "secret" not in str(refused.value) and "\n" not in str(refused.value)


def test_the_driver_that_is_named_is_the_one_that_is_pinned():
    pins = (ROOT / "requirements.txt").read_text().splitlines()
    assert database.PSYCOPG in pins


def test_a_database_s_complaint_is_one_line_without_the_statement():
    error = OperationalError("INSERT INTO student", {"id": "ann"}, Exception("disk is full\n  DETAIL:  quite"))
    assert database.why(error) == "disk is full DETAIL: quite"
    assert database.why(OSError(28, "No space left on device", "x")) == "[Errno 28] No space left on device: 'x'"


def test_grading_refuses_it_as_an_unusable_argument(tmp_path):
    (tmp_path / "submitted" / "ann" / "ch44").mkdir(parents=True)
    words = [
        "grade",
        str(tmp_path / "submitted"),
        "--out",
        str(tmp_path / "grades"),
        "--trust-submissions",
        "--db-url",
        "nonsense",
    ]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 2, result.output
    [line] = result.stderr.splitlines()
    assert line.startswith("course: --db-url is not the address of a database, such as ")


def test_giving_back_refuses_it_too(tmp_path, monkeypatch):
    monkeypatch.setattr(give_back, "read_all", lambda folder: [SimpleNamespace(assignment="ch44")])
    with pytest.raises(give_back.GiveBackError, match="--db-url is not the address"):
        give_back.load(tmp_path, None, "nonsense")
