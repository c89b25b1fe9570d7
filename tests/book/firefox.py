"""Firefox ESR as a reader has it, driven over Marionette, the protocol that it brings along.

Drivers switch on preferences that make tests easier, among them one that lets pages from disk read each other; here they stay off.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

PREFERENCES = {
    "remote.prefs.recommended": False,
    "marionette.port": 0,  # any that is free
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "app.update.enabled": False,
    "network.proxy.type": 1,  # to nowhere: what asks for something elsewhere fails
    "network.proxy.http": "127.0.0.1",
    "network.proxy.http_port": 9,
    "network.proxy.ssl": "127.0.0.1",
    "network.proxy.ssl_port": 9,
    "browser.download.folderList": 2,
    "browser.download.useDownloadDir": True,
}
PATIENCE = 120  # seconds: a busy machine is slow, not wrong


class FirefoxError(Exception):
    """What Firefox or a script in it complained of."""


class Firefox:
    """A headless Firefox with a profile of its own in `folder`, where its downloads go, too."""

    def __init__(self, folder: Path):
        program = shutil.which("firefox-esr") or shutil.which("firefox")
        assert program, "no Firefox found: run tools/system-packages, or `apt-get install firefox-esr`, then test again"
        lines = [f'user_pref("{name}", {json.dumps(value)});' for name, value in PREFERENCES.items()]
        lines.append(f'user_pref("browser.download.dir", {json.dumps(str(folder))});')
        (folder / "user.js").write_text("\n".join(lines), encoding="utf-8")
        command = [program, "--headless", "--no-remote", "--marionette", "--profile", str(folder)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=folder)
        self._socket = socket.create_connection(("127.0.0.1", self._port(folder / "MarionetteActivePort")), timeout=PATIENCE)
        self._stream = self._socket.makefile("rb")
        self._asked = 0
        self._read()  # who it is
        self.ask("WebDriver:NewSession", capabilities={"alwaysMatch": {"unhandledPromptBehavior": "accept"}})
        self.ask("WebDriver:SetTimeouts", script=1000 * PATIENCE, pageLoad=1000 * PATIENCE, implicit=0)

    def _port(self, file: Path) -> int:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            with contextlib.suppress(OSError, ValueError):
                return int(file.read_text(encoding="utf-8"))
            assert self._process.poll() is None, "Firefox ended at once"
            time.sleep(0.1)
        raise FirefoxError("Firefox did not start")

    def _read(self) -> Any:
        length = b""
        while (one := self._stream.read(1)) != b":":
            length += one
        return json.loads(self._stream.read(int(length)))

    def ask(self, command: str, **parameters: Any) -> Any:
        """Send a command and wait for its answer. Raises FirefoxError."""
        self._asked += 1
        message = json.dumps([0, self._asked, command, parameters]).encode()
        self._socket.sendall(str(len(message)).encode() + b":" + message)
        _, _, error, result = self._read()
        if error:
            raise FirefoxError(f"{error['error']}: {error['message']}")
        return result

    def open(self, path: Path) -> None:
        self.ask("WebDriver:Navigate", url=path.as_uri())

    def run(self, body: str, *arguments: Any) -> Any:
        """What an async function with this body returns in the page; `arguments` are its arguments, by that name."""
        script = f"""const done = arguments[arguments.length - 1], given = [...arguments].slice(0, -1);
            (async (...arguments) => {{ {body} }})(...given).then((value) => done({{value}}), (error) => done({{error: String(error)}}));"""
        told = self.ask("WebDriver:ExecuteAsyncScript", script=script, args=list(arguments), newSandbox=False, sandbox=None)[
            "value"
        ]
        if "error" in told:
            raise FirefoxError(told["error"])
        return told.get("value")

    def press(self, *keys: str) -> None:
        """Press keys one after the other; of "Control+Enter", together."""
        names = {"Tab": "\ue004", "Enter": "\ue007", "Escape": "\ue00c", "Control": "\ue009", "End": "\ue010", "Home": "\ue011"}
        strokes = []
        for key in keys:
            parts = [names.get(part, part) for part in (key.split("+") if len(key) > 1 else [key])]
            strokes += [{"type": "keyDown", "value": part} for part in parts]
            strokes += [{"type": "keyUp", "value": part} for part in reversed(parts)]
        self.ask("WebDriver:PerformActions", actions=[{"type": "key", "id": "keyboard", "actions": strokes}])

    def __enter__(self) -> Firefox:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(Exception):
            self.ask("Marionette:Quit", flags=["eForceQuit"])
        self._socket.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
