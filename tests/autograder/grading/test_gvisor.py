"""The stronger wall, behind the same interface: gVisor's kernel answers, nothing of the host is to be seen, limits and deadlines hold,
and everything goes with whoever started it. Nothing is skipped where runsc is missing; tools/system-packages installs it."""

import json
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest

from autograder.grading import bubblewrap, gvisor, sandbox
from autograder.grading.sandbox import Limits, MiB, Sandbox, SandboxDied, SandboxTimeout, SandboxUnavailable
from tests.autograder.grading.inside import PRELUDE

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def enter(tmp_path):
    """enter(code, **arguments of Sandbox) → an unopened Sandbox in gVisor that runs PRELUDE and code."""

    def make(code, **arguments):
        script = tmp_path / f"attack{len(list(tmp_path.iterdir()))}.py"
        script.write_text(PRELUDE + textwrap.dedent(code))
        return Sandbox(script, wall="gvisor", **arguments)

    return make


def test_another_kernel_answers_and_shows_nothing_of_the_host(enter, monkeypatch):
    monkeypatch.setenv("GRADER_SECRET", "hunter2-canvas-token")
    code = f"""
        paths = ["/etc/passwd", "/etc/shadow", "/root", "/home", "/var", "/run", "/opt", "/usr/bin", {str(ROOT)!r}, {str(Path.home())!r}]
        mounts = open("/proc/mounts").read() + open("/proc/self/mountinfo").read()
        seen = dict(os.environ), open("/proc/1/cmdline").read(), open("/proc/1/environ").read(), mounts
        found = [path for path in paths if os.path.exists(path)]
        say([open("/proc/cmdline").read(), found, seen, os.listdir("/"), os.getuid(), socket.gethostname()])
    """
    with enter(code) as box:
        kernel, found, seen, root, user, name = json.loads(box.receive(20))
    assert "gvisor" in kernel and "gvisor" not in Path("/proc/cmdline").read_text()
    assert found == [] and user == 65534 and name == "sandbox"
    assert set(root) <= {"course", "dev", "etc", "handed", "lib", "lib64", "proc", "python", "site", "sys", "tmp", "usr", "work"}
    assert set(seen[0]) <= {*bubblewrap.ENVIRONMENT, "LD_LIBRARY_PATH", "PWD", "LC_CTYPE"}
    assert not any(secret in json.dumps(seen) for secret in ("hunter2", "GRADER_SECRET", str(ROOT), str(Path.home())))


def test_no_network_no_privilege_and_little_to_write(enter):
    code = """
        import shutil
        listener = outcome(socket.create_connection, ("127.0.0.1", int(hear())), 2)
        places = [outcome(open, f"{folder}/x", "w") for folder in ("/", "/course", "/site", "/python/lib", "/usr/lib", "/handed", "/etc")]
        ups = [outcome(os.setuid, 0), outcome(os.chroot, "/tmp")]
        os.mknod("/tmp/disk", 0o60666, os.makedev(254, 0))  # a name that leads nowhere: this kernel has no such device
        ups.append(outcome(open, "/tmp/disk", "rb"))
        ups.append("done" if libc.mount(b"none", b"/tmp", b"tmpfs", 0, None) == 0 else errno.errorcode[ctypes.get_errno()])
        sizes = [shutil.disk_usage(folder).total for folder in ("/work", "/tmp", "/dev/shm")]
        say([listener, outcome(socket.create_connection, ("192.0.2.1", 80), 2), places, ups, sizes])
    """
    with socket.create_server(("127.0.0.1", 0)) as server, enter(code) as box:
        box.send(str(server.getsockname()[1]).encode())
        own, other, places, ups, sizes = json.loads(box.receive(20))
    assert own == "ECONNREFUSED" and other in ("ENETUNREACH", "EHOSTUNREACH")
    assert set(places) <= {"EROFS", "EACCES"} and set(ups) <= {"EPERM", "EINVAL", "ENXIO"}, ups
    assert sizes == [128 * MiB, 128 * MiB, 64 * MiB]


def test_files_lie_in_work_and_a_learner_may_change_them_there(enter, tmp_path):
    policy, helper = tmp_path / "policy", tmp_path / "helper"
    policy.write_bytes(bytes(range(256)))
    helper.write_text("answer = 42")
    code = """
        import helper
        with open("data/policy.pt", "rb") as file:
            content = file.read()
        os.remove("data/policy.pt")
        say([os.getcwd(), list(content), helper.answer, os.listdir("data")])
    """
    with enter(code, files={"data/policy.pt": policy, "helper.py": helper}) as box:
        assert json.loads(box.receive(20)) == ["/work", list(range(256)), 42, []]
    assert policy.read_bytes() == bytes(range(256))


def test_frames_come_back_whole(enter):
    with enter("while True:\n    data = hear(); channel.sendall(len(data).to_bytes(8, 'big') + data)") as box:
        for size in (0, 1, 1 << 20, 20 << 20):
            payload = bytes(range(256)) * (size // 256) + b"x" * (size % 256)
            box.send(payload)
            assert box.receive(30) == payload


def test_limits_hold(enter):
    code = """
        def grow():
            with open("/tmp/big", "wb") as file:
                while True:
                    file.write(b"0" * (1 << 20))
        forks = 0
        try:
            while forks < 500:
                if os.fork() == 0:
                    time.sleep(60)
                forks += 1
        except OSError as error:
            say([forks, errno.errorcode[error.errno], outcome(grow), outcome(bytearray, 8 << 30)])
    """
    with enter(code, limits=Limits(file_size=8 * MiB, processes=16)) as box:
        forks, why, file, memory = json.loads(box.receive(30))
    assert (forks < 16, why, file, memory) == (True, "EAGAIN", "EFBIG", "MemoryError")


@pytest.mark.parametrize("kind", ["bytearray(b'x' * (40 << 20))", "shared()"])
def test_too_much_memory_ends_it(enter, kind):
    code = f"""
        import mmap
        kept = []
        def shared():
            memory = mmap.mmap(-1, 40 << 20)
            memory.write(b"x" * (40 << 20))
            return memory
        for _ in range(3):
            if os.fork() == 0:
                break
        while True:
            kept.append({kind})
            time.sleep(0.1)
    """
    with enter(code, limits=Limits(memory=600 * MiB)) as box, pytest.raises(SandboxDied, match="killed for its memory"):
        box.receive(60)


def test_silence_ends_at_the_deadline_and_a_death_says_how(enter):
    with enter("time.sleep(100)") as box:
        start = time.monotonic()
        with pytest.raises(SandboxTimeout):
            box.receive(0.5)
        assert time.monotonic() - start < 5
    for code, text in (("os._exit(3)", "exited with status 3"), ("os.kill(os.getpid(), signal.SIGSEGV)", "killed by SIGSEGV")):
        with enter(code) as box, pytest.raises(SandboxDied, match=text):
            box.receive(20)


def test_two_live_side_by_side_and_nothing_is_left(enter, tmp_path):
    code = """
        open("/tmp/mine", "w").close()
        say(os.listdir("/tmp"))
        if os.fork() == 0:
            os.setsid()
        time.sleep(100)
    """
    with enter(code) as one, enter(code) as other:
        assert json.loads(one.receive(20)) == json.loads(other.receive(20)) == ["mine"]
        pids = [process.pid for box in (one, other) for process in (*box._tree(), box._root)]
        folders = [Path(box._folder.name) for box in (one, other)]
        assert len(pids) >= 6 and all(folder.is_dir() for folder in folders)
    assert gone(pids) and not any(folder.exists() for folder in folders)


def test_everything_goes_when_the_grader_is_killed(tmp_path):
    script = tmp_path / "sleeper.py"
    script.write_text("import os, time; os.fork(); os.setsid() if os.getpid() != 1 else None; time.sleep(100)")
    grader = f"""
import tempfile, time
from pathlib import Path
tempfile.tempdir = {str(tmp_path)!r}
from autograder.grading.sandbox import Sandbox
with Sandbox(Path({str(script)!r}), wall="gvisor") as box:
    time.sleep(0.3)
    print(*[process.pid for process in (*box._tree(), box._root)], flush=True)
    time.sleep(100)
"""
    process = subprocess.Popen([sys.executable, "-c", grader], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    with process:
        pids = [int(pid) for pid in process.stdout.readline().split()]
        assert len(pids) >= 4
        process.kill()
    assert gone(pids)


def gone(pids, within=30.0):
    end = time.monotonic() + within
    while (left := [pid for pid in pids if _alive(pid)]) and time.monotonic() < end:
        time.sleep(0.01)
    return not left


def _alive(pid):
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_torch_imports_inside():
    assert sandbox.probe(torch=True, wall="gvisor") == []


def test_without_runsc_it_refuses_and_says_how_to_get_it(enter, monkeypatch):
    monkeypatch.setattr(gvisor.shutil, "which", lambda name: None)
    with pytest.raises(SandboxUnavailable, match="install gVisor"):
        enter("").__enter__()
    assert "apt install runsc" in sandbox.probe(wall="gvisor")[0].remedy


def test_a_failing_runsc_is_ours_and_explained(enter, monkeypatch, tmp_path):
    program = tmp_path / "runsc"
    program.write_text("#!/bin/sh\necho 'no such platform' >&2\nexit 1\n")
    program.chmod(0o755)
    which = gvisor.shutil.which
    monkeypatch.setattr(gvisor.shutil, "which", lambda name: str(program) if name == "runsc" else which(name))
    with pytest.raises(SandboxUnavailable, match=r"gVisor does not start: no such platform.*shows whether"):
        enter("").__enter__()


def test_a_wall_that_there_is_not_is_refused(tmp_path):
    with pytest.raises(ValueError, match="take one of bubblewrap, gvisor"):
        Sandbox(tmp_path / "x.py", wall="paper")
