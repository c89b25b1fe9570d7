"""A PostgreSQL server of a test's own: in a temporary folder, on a Unix socket there, ended with the test. It refuses to run as root."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

OWNER, PASSWORD = "teacher", "two words: p@ss/word"
DEBIAN = Path("/usr/lib/postgresql")  # where its programs lie, a folder for each version, none of them on PATH


def program(name: str) -> str:
    found = shutil.which(name) or next(map(str, sorted(DEBIAN.glob(f"*/bin/{name}"), reverse=True)), None)
    assert found, f"no PostgreSQL ({name}) found: run tools/system-packages, or `apt-get install postgresql`, then test again"
    return found


class Server:
    """With databases that are made on demand; may be stopped and started again."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="pg-", dir="/tmp"))  # a socket's path must be short
        self.data, password = self.folder / "data", self.folder / "password"
        password.write_text(PASSWORD)
        self.user = ["setpriv", "--pdeathsig", "KILL"]
        if os.geteuid() == 0:
            nobody = pwd.getpwnam("nobody")
            self.user += [f"--reuid={nobody.pw_uid}", f"--regid={nobody.pw_gid}", "--clear-groups"]
            for path in (self.folder, password):
                os.chown(path, nobody.pw_uid, nobody.pw_gid)
        words = ["-D", str(self.data), "-U", OWNER, "-A", "scram-sha-256", "--pwfile", str(password)]
        self._run("initdb", *words, "-E", "UTF8", "--locale=C", "--no-sync")
        self.start()

    def start(self) -> None:
        words = ["-D", str(self.data), "-k", str(self.folder), "-c", "listen_addresses=", "-c", "fsync=off"]
        command = [*self.user, program("postgres"), *words]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log, start_new_session=True)
        deadline = time.monotonic() + 60
        while subprocess.run([program("pg_isready"), "-q", "-h", self.folder]).returncode:
            ended = self.process.poll() is not None or time.monotonic() > deadline
            assert not ended, (self.folder / "log").read_text()
            time.sleep(0.1)

    def stop(self) -> None:
        """At once, as a server goes whose machine goes; what is committed is there when it is back."""
        self.process.send_signal(signal.SIGQUIT)
        self.process.wait(60)

    def remove(self) -> None:
        self.stop()
        shutil.rmtree(self.folder)

    def url(self, database: str, password: str = PASSWORD) -> str:
        from sqlalchemy import URL

        where = {"host": str(self.folder)}
        return URL.create("postgresql", OWNER, password, database=database, query=where).render_as_string(hide_password=False)

    def new(self, database: str) -> str:
        """The URL of a new, empty database."""
        self._run("createdb", "-h", str(self.folder), "-U", OWNER, database, PGPASSWORD=PASSWORD)
        return self.url(database)

    def _run(self, name: str, *words: str, **environment: str) -> None:
        done = subprocess.run(
            [*self.user, program(name), *words], cwd=self.folder, env=os.environ | environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert not done.returncode, done.stdout
