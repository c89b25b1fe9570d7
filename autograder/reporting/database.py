"""The database of the gradebook: SQLite unless asked otherwise, or PostgreSQL through psycopg; and what is wrong with one, in a line.

In both, a transaction begins by waiting for its turn: one that reads first and writes later would otherwise do so on what another grader
has changed meanwhile. SQLite runs with a write-ahead log, in which readers such as formgrader never block the writer; the log needs a
local disk. PostgreSQL takes a lock that only this project knows, so that formgrader never waits for it.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import URL, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

BUSY_SECONDS = 60
CONNECT_SECONDS = 10
TURN = 0x636F75727365  # the number of PostgreSQL's lock: "course"
PSYCOPG = "psycopg[binary]==3.3.9"
EXAMPLES = "sqlite:////home/me/gradebook.db or postgresql://me@host/course"


class UnusableURL(ValueError):
    """It names no database, or one whose driver is not installed; the message says what to do."""


def address(db_url: str | URL) -> URL:
    """The URL with the driver that is meant. Raises: UnusableURL."""
    try:
        url = make_url(db_url)
    except (ArgumentError, ValueError):  # it is not repeated, as there may be a password in it
        raise UnusableURL(f"--db-url is not the address of a database, such as {EXAMPLES}") from None
    return url.set(drivername="postgresql+psycopg") if url.drivername in ("postgresql", "postgres") else url


def engine(db_url: str | URL) -> Engine:
    """An engine whose transactions take turns; it connects when it is used. Raises: UnusableURL."""
    url = address(db_url)
    postgresql = url.get_backend_name() == "postgresql"
    options: dict[str, Any] = {}
    if postgresql:
        options["isolation_level"] = "READ COMMITTED"  # each statement sees what was written before its turn
        options["connect_args"] = {"connect_timeout": url.query.get("connect_timeout", CONNECT_SECONDS)}
    try:
        made = create_engine(url, **options)
    except NoSuchModuleError:
        raise UnusableURL(f"--db-url: no kind of database is called {url.drivername!r}; take one such as {EXAMPLES}") from None
    except ModuleNotFoundError as error:
        remedy = f"pip install '{PSYCOPG}'" if error.name == "psycopg" else f"install {error.name}"
        raise UnusableURL(f"--db-url: {url.drivername} needs a driver that is not here: {remedy}") from None
    if made.dialect.name == "sqlite":
        _take_turns_on_sqlite(made)
    elif postgresql:
        _take_turns_on_postgresql(made)
    return made


def try_it(db_url: str | URL) -> None:
    """Connect once. Raises: UnusableURL; SQLAlchemyError if the database refuses."""
    tried = engine(db_url)
    try:
        tried.connect().close()
    finally:
        tried.dispose()


def why(error: Exception) -> str:
    """What a database, or a file system, says, in one line: without the statement, which holds names and points."""
    said = error.orig if isinstance(error, DBAPIError) and error.orig else error
    return " ".join(str(said).split())


def _take_turns_on_sqlite(made: Engine) -> None:
    @event.listens_for(made, "connect")
    def _prepare(connection, _record):
        connection.isolation_level = None  # the driver would begin transactions late, and only before writes
        connection.execute(f"PRAGMA busy_timeout = {BUSY_SECONDS * 1000}")
        connection.execute("PRAGMA journal_mode = WAL")

    @event.listens_for(made, "begin")
    def _begin(connection):
        # One that reads first and writes later is refused at once, without waiting, when another has written meanwhile.
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def _take_turns_on_postgresql(made: Engine) -> None:
    @event.listens_for(made, "begin")
    def _begin(connection):
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = '{BUSY_SECONDS}s'")
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({TURN})")
