"""The sandbox holds against code that tries to get out of it, to stay, or to take the machine down.

Each attack is a script that runs inside and reports what it managed to do. Nothing is skipped where bubblewrap is missing: a
grader without a sandbox is a broken grader.
"""

import json
import os
import socket
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from autograder.grading import bubblewrap, sandbox
from autograder.grading.forking import ForkServer
from autograder.grading.sandbox import Limits, MiB, Sandbox, SandboxDied, SandboxGarbage, SandboxTimeout, SandboxUnavailable
from autograder.paths import COURSE_LIB
from tests.autograder.grading.inside import PRELUDE

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = str(Path(pytest.__file__).parents[1])  # where this machine has installed them

# so that a mistake in a test's own script can be read
SAY_ERRORS = """
import traceback
sys.excepthook = lambda *error: say("".join(traceback.format_exception(*error)))
"""


@pytest.fixture(scope="module", params=["anew", "forked"])
def server_with(request):
    """Both ways to begin: server_with(modules) → None, for a process of its own, or a server that forks it."""
    servers = {}

    def of(modules):
        if request.param == "anew":
            return None
        if modules not in servers:
            servers[modules] = ForkServer(modules, preload=())
        return servers[modules]

    yield of
    for server in servers.values():
        server.close()


@pytest.fixture
def enter(tmp_path, server_with):
    """enter(code, **arguments of Sandbox) → an unopened Sandbox that runs PRELUDE and code."""

    def make(code, modules=(), **arguments):
        script = tmp_path / f"attack{len(list(tmp_path.iterdir()))}.py"
        script.write_text(PRELUDE + textwrap.dedent(code))
        return Sandbox(script, modules, server=server_with(tuple(modules)), **arguments)

    return make


@pytest.fixture
def enter_anew(tmp_path):
    """Likewise, where what is tried is how a process of its own begins."""

    def make(code):
        script = tmp_path / "begins.py"
        script.write_text(PRELUDE + code)
        return Sandbox(script)

    return make


@pytest.fixture
def ask(enter):
    """ask(code) → what code says first."""

    def run(code, timeout=20.0, **arguments):
        with enter(SAY_ERRORS + textwrap.dedent(code), **arguments) as box:
            return json.loads(box.receive(timeout))

    return run


def inside(box):
    return [process.pid for process in box._tree()]


def alive(pid):
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE  # an orphan's corpse waits for the machine's init
    except psutil.NoSuchProcess:
        return False


def gone(pids, within=30.0):
    end = time.monotonic() + within
    while any(map(alive, pids)) and time.monotonic() < end:
        time.sleep(0.01)
    return not any(map(alive, pids))


# --- it works -------------------------------------------------------------------------------------------------------


def test_frames_of_every_size_come_back_unchanged(enter):
    code = """
        while True:
            data = hear()
            channel.sendall(len(data).to_bytes(8, "big") + data)
    """
    with enter(code) as box:
        for payload in (b"", b"x", os.urandom(3 * MiB + 1)):
            box.send(payload)
            assert box.receive(10) == payload


def test_the_learners_packages_import_and_work_within_the_limits(ask):
    code = """
        import gymnasium, ipywidgets, matplotlib.pyplot as plt, numpy, safetensors.torch, torch, tqdm
        x = torch.ones(300, 300, requires_grad=True)
        (x @ x).sum().backward()
        plt.plot([1, 2])
        plt.savefig("figure.png")
        gymnasium.make("Hopper-v5").reset(seed=0)
        gymnasium.make("LunarLander-v3").reset(seed=0)
        say([float(x.grad[0, 0]), os.path.getsize("figure.png") > 0, plt.get_backend(), torch.get_num_threads()])
    """
    assert ask(code, timeout=40) == [600.0, True, "Agg", 1]


def test_a_cell_that_loads_the_tiny_language_model_runs(ask):
    code = """
        from course_lib.language import lm, preferences
        say([lm.load("tiny").context, len(preferences.load("test").texts) > 100])
    """
    assert ask(code, timeout=40, modules=[COURSE_LIB]) == [128, True]


def test_starting_costs_little_beside_the_interpreter(ask):
    """Nothing but the standard library is imported before the script, and the list of mounts is made once in a process."""
    foreign = "say(sorted({name.partition('.')[0] for name in sys.modules} - {'__main__'} - set(sys.stdlib_module_names)))"
    assert ask(foreign) == []
    made = bubblewrap.host_mounts.cache_info().misses
    assert ask(foreign) == [] and bubblewrap.host_mounts.cache_info().misses == made


def test_ipython_reads_cells_inside(ask):
    code = """
        from course_lib.checks.notebook import new_namespace, run_cell
        namespace = new_namespace()
        run_cell("a = 1", namespace)
        before = "IPython" in sys.modules
        run_cell("%%time\\n!ls \\\\\\n  -l\\nx = [1,\\n  2] # or 3?", namespace)
        say([namespace["x"], before, "IPython" in sys.modules])
    """
    assert ask(code, timeout=40, modules=[COURSE_LIB]) == [[1, 2], False, True]


def test_files_are_readable_and_importable_but_shadow_nothing(ask, tmp_path):
    (tmp_path / "random.py").write_text("shadowed = True")
    (tmp_path / "numpy.py").write_text("shadowed = True")
    (tmp_path / "mine.py").write_text("value = 7")
    (tmp_path / "mine.py").chmod(0o600)
    module = tmp_path / "course_module"
    module.mkdir()
    (module / "__init__.py").write_text("here = __file__")
    (tmp_path / "course_module.py").write_text("here = 'shadowed'")
    names = ["random.py", "numpy.py", "mine.py", "course_module.py"]
    files = {**{name: tmp_path / name for name in names}, "sub/mine.txt": tmp_path / "mine.py"}
    code = """
        import course_module, mine, numpy, random
        say([mine.value, hasattr(random, "shadowed"), hasattr(numpy, "shadowed"), course_module.here, open("sub/mine.txt").read(),
             os.getcwd(), sys.path[-3:]])
    """
    expected = [7, False, False, "/course/course_module/__init__.py", "value = 7", "/work", ["/course", "/site", "/work"]]
    assert ask(code, files=files, modules=[module]) == expected


def test_trusted_runs_the_same_script_without_bubblewrap(enter, tmp_path):
    (tmp_path / "mine.py").write_text("value = 7")
    code = """
        import subprocess
        import mine
        daemon = subprocess.Popen(["sleep", "100"])
        say([mine.value, os.getpid(), sys.stdout is not None])
        time.sleep(100)
    """
    with enter(code, files={"mine.py": tmp_path / "mine.py"}, trusted=True) as box:
        value, pid, _ = json.loads(box.receive(10))
        pids = [*inside(box), pid]
        assert value == 7 and len(pids) == 2 and psutil.pid_exists(pid)
    assert gone(pids)


# --- reading what is not theirs -------------------------------------------------------------------------------------


def test_no_file_of_the_host_is_visible(ask):
    code = f"""
        paths = ["/etc/passwd", "/etc/shadow", "/etc/hostname", "/root", "/home", "/var", "/run", "/sys", "/opt", "/mnt",
                 "/usr/bin", "/usr/local", "/tools", "/oldroot", "/newroot", {str(ROOT)!r}, {str(Path.home())!r}, {PACKAGES!r}]
        found = [path for path in paths if os.path.exists(path)]
        bases = ("/work", "/proc/self/cwd", "/proc/1/root", "/proc/1/cwd")
        up = [os.path.exists(f"{{base}}/../../../../{str(ROOT)[1:]}") for base in bases]
        say([sorted(os.listdir("/")), sorted(os.listdir("/usr")), os.listdir("/etc"), os.listdir("/work"), found, up])
    """
    root, usr, etc, work, found, up = ask(code)
    assert set(root) <= {"course", "dev", "etc", "lib", "lib64", "proc", "python", "site", "tmp", "usr", "work"}
    assert set(usr) <= {"lib", "lib64"} and set(etc) <= {"ld.so.cache"} and work == []
    assert found == [] and not any(up)


def test_no_environment_and_no_arguments_of_the_grader_are_visible(ask, monkeypatch):
    monkeypatch.setenv("GRADER_SECRET", "hunter2-canvas-token")
    code = """
        text = {}
        for pid in filter(str.isdigit, os.listdir("/proc")):
            for name in ("environ", "cmdline"):
                try:
                    text[f"{pid}/{name}"] = open(f"/proc/{pid}/{name}", "rb").read().decode()
                except OSError:
                    pass
        say([text, dict(os.environ), socket.gethostname()])
    """
    text, environment, name = ask(code)
    assert name == "sandbox"
    everything = json.dumps([text, environment])
    assert "hunter2" not in everything and "GRADER_SECRET" not in everything
    assert str(ROOT) not in everything and PACKAGES not in everything
    first = {line.partition("=")[0] for line in text["1/environ"].split("\0")}
    assert first <= {"", "PWD", "LD_LIBRARY_PATH", *bubblewrap.ENVIRONMENT}
    assert set(environment) <= {*bubblewrap.ENVIRONMENT, "LD_LIBRARY_PATH", "PWD", "LC_CTYPE"}


def test_no_other_process_is_visible(ask):
    code = """
        say(sorted(int(pid) for pid in filter(str.isdigit, os.listdir("/proc"))))
    """
    assert ask(code) == [1, 2]


def test_only_the_channel_is_open(ask):
    leak, other = os.pipe()
    os.set_inheritable(leak, True)
    code = """
        say({fd: os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")
             or os.path.islink(f"/proc/self/fd/{fd}")})
    """
    try:
        targets = sorted(target.split(":")[0] for target in ask(code).values())
    finally:
        os.close(leak)
        os.close(other)
    assert targets == ["/dev/null", "/dev/null", "/dev/null", "socket"]


def test_solutions_autograder_and_nbgrader_cannot_be_imported(ask):
    code = """
        import importlib
        names = ["solutions", "solutions.ch44", "autograder", "autograder.grading.sandbox", "nbgrader", "course_lib", "pytest", "dask"]
        sys.path += ["/python/lib/python3.11/site-packages", "/python/lib/python3.11/dist-packages",
                     "/usr/lib/python3/dist-packages", "/usr/local/lib/python3.11/dist-packages"]
        say({name: outcome(importlib.import_module, name) for name in names})
    """
    assert set(ask(code).values()) == {"ModuleNotFoundError"}


def test_an_installed_solutions_package_is_never_mounted(tmp_path, monkeypatch):
    info = tmp_path / "solutions-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: solutions\nVersion: 1\n")
    (info / "RECORD").write_text("solutions/__init__.py,,\n__editable__.solutions.pth,,\n")
    (tmp_path / "solutions").mkdir()
    (tmp_path / "solutions/__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    bubblewrap.packages.cache_clear()
    try:
        names = bubblewrap.packages()
    finally:
        bubblewrap.packages.cache_clear()
    assert {"torch", "numpy", "gymnasium", "mujoco", "Box2D"} <= set(names)
    assert not [name for name in names if name.startswith(("solutions", "autograder", "nbgrader", "course", "__editable__"))]
    assert not [name for name in names if name.endswith(".pth")]


def test_no_network_not_even_the_hosts_loopback(ask):
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_UNIX) as abstract:
        abstract.bind(f"\0sandbox-test-{os.getpid()}")
        abstract.listen()
        code = f"""
            def tcp(address):
                return outcome(socket.create_connection, address, 1)
            unix = socket.socket(socket.AF_UNIX)
            say([tcp(("127.0.0.1", {server.getsockname()[1]})), tcp(("192.0.2.1", 80)), tcp(("8.8.8.8", 53)),
                 outcome(unix.connect, "\\0sandbox-test-{os.getpid()}")])
        """
        assert ask(code) == ["ECONNREFUSED", "ENETUNREACH", "ENETUNREACH", "ECONNREFUSED"]


# --- writing, and climbing ------------------------------------------------------------------------------------------


def test_nothing_but_work_tmp_and_shm_can_be_written(ask):
    code = """
        def write(folder):
            def attempt():
                with open(f"{folder}/written", "w") as file:
                    file.write("x")
                return "written"
            return outcome(attempt)
        folders = ["/", "/site", "/site/numpy", "/course", "/python", "/python/lib", "/python/lib/python3.11/site-packages",
                   "/usr/lib", "/lib64", "/etc", "/dev", "/dev/pts", "/proc", "/proc/sys/kernel", "/usr"]
        say([{folder: write(folder) for folder in folders}, [write(folder) for folder in ("/work", "/tmp", "/dev/shm")],
             outcome(open, __file__, "a"), outcome(os.chmod, __file__, 0o777),
             outcome(open, "/proc/sys/kernel/core_pattern", "w")])
    """
    refused, allowed, *own = ask(code)
    assert set(refused.values()) <= {"EROFS", "EACCES", "ENOENT", "EPERM"}, refused
    assert allowed == ["'written'"] * 3
    assert all(one in ("EROFS", "EACCES", "ENOENT") for one in own), own  # a forked script has no file


@pytest.mark.parametrize(("folder", "size"), [("/work", "work"), ("/tmp", "tmp"), ("/dev/shm", "shm")])
def test_filling_a_folder_ends_at_its_size(ask, folder, size):
    code = f"""
        written = 0
        try:
            for i in range(100):
                with open(f"{folder}/{{i}}", "wb", buffering=0) as file:
                    written += file.write(bytes({MiB}))
        except OSError as error:
            say([written, errno.errorcode[error.errno]])
        else:
            say([written, "no end"])
    """
    written, how = ask(code, limits=Limits(**{size: 8 * MiB}))
    assert how == "ENOSPC" and written <= 8 * MiB


def test_a_file_cannot_grow_beyond_its_limit(ask):
    code = f"""
        def grow():
            with open("/tmp/big", "wb") as file:
                file.seek({9 * MiB})
                file.write(b"x")
        say(outcome(grow))
    """
    assert ask(code, limits=Limits(file_size=8 * MiB)) == "EFBIG"


def test_capabilities_namespaces_mounts_and_tracing_are_out_of_reach(ask):
    code = """
        NEWUSER, NEWNS = 0x10000000, 0x00020000
        x86 = os.uname().machine == "x86_64"
        clone = 56 if x86 else 220
        status = dict(line.split(":", 1) for line in open("/proc/self/status"))
        def failed(result):
            return "done" if result == 0 else errno.errorcode[ctypes.get_errno()]
        say({
            "capabilities": sum(int(status[key], 16) for key in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")),
            "no new privileges": status["NoNewPrivs"].strip(),
            "root": outcome(os.setuid, 0),
            "unshare user": failed(libc.unshare(NEWUSER)),
            "unshare mount": failed(libc.unshare(NEWNS)),
            "clone user": syscall(clone, NEWUSER | signal.SIGCHLD, 0, 0, 0, 0),
            "mount": failed(libc.mount(b"none", b"/tmp", b"tmpfs", 0, None)),
            "remount": failed(libc.mount(None, b"/site", None, 32, None)),
            "umount": failed(libc.umount2(b"/proc", 2)),
            "chroot": outcome(os.chroot, "/tmp"),
            "ptrace": failed(libc.ptrace(16, 1, 0, 0)),
            "memory of 1": outcome(open, "/proc/1/mem", "r+b"),
            "keyring": syscall(250 if x86 else 219, 0, -3, 1),
            "memfd": outcome(os.memfd_create, "x"),
            "shared memory": syscall(29 if x86 else 194, 0, 1 << 30, 0o1600),
            "io_uring": syscall(425, 8, 0),
            "mknod": outcome(os.mknod, "/tmp/disk", 0o60666, os.makedev(254, 0)),
        })
    """
    said = ask(code)
    assert said.pop("capabilities") == 0 and said.pop("no new privileges") == "1"
    assert said.pop("clone user") in ("ENOSPC", "EPERM")
    said.pop("memory of 1")  # process 1 is bwrap without any privilege: nothing is won by writing into it
    assert said.pop("root") in ("EPERM", "EINVAL")
    assert set(said.values()) == {"EPERM"}, said


def test_writing_into_process_1_wins_nothing(enter):
    code = """
        try:
            with open("/proc/1/maps") as maps, open("/proc/1/mem", "r+b", buffering=0) as memory:
                for line in maps:
                    start, end = (int(x, 16) for x in line.split()[0].split("-"))
                    if " r-xp " in line and "bwrap" in line or "libc" in line and " r-xp " in line:
                        memory.seek(start)
                        memory.write(b"\\xcc" * (end - start))
        except OSError:
            pass
        os.kill(1, signal.SIGTERM)
        say([os.getuid(), os.path.exists("/etc/passwd")])
        time.sleep(100)
    """
    with enter(code) as box:
        with suppress(SandboxDied):
            assert json.loads(box.receive(10)) == [65534, False]
        pids = inside(box)
    assert gone(pids)


def test_kill_everything_kills_only_itself(enter):
    with enter("hear(); say(1)") as neighbour:
        with (
            enter("outcome(os.kill, -1, signal.SIGKILL); os.kill(os.getpid(), signal.SIGKILL)") as box,
            pytest.raises(SandboxDied, match="SIGKILL"),
        ):
            box.receive(10)
        neighbour.send(b"")
        assert json.loads(neighbour.receive(10)) == 1


# --- exhausting the machine -----------------------------------------------------------------------------------------


def test_a_fork_bomb_is_contained_and_cleared(enter):
    code = """
        say("go")
        while True:
            try:
                os.fork()
            except OSError:
                pass
    """
    with enter(code) as box:
        box.receive(10)
        end = time.monotonic() + 10
        while len(pids := inside(box)) <= 20 and time.monotonic() < end:
            time.sleep(0.1)
        assert 20 < len(pids) <= 64 + 4  # and the layers' own
    assert gone(pids)


def test_the_process_limit_counts_each_sandbox_by_itself(enter):
    code = """
        children = []
        for _ in range(40):
            pid = os.fork()
            if pid == 0:
                time.sleep(100)
            children.append(pid)
        say(len(children))
        time.sleep(100)
    """
    with enter(code) as one, enter(code) as two:
        assert json.loads(one.receive(10)) == json.loads(two.receive(10)) == 40


def test_one_process_cannot_take_more_than_its_memory(ask):
    assert ask("say(outcome(bytearray, 1 << 30))", limits=Limits(address_space=512 * MiB)) == "MemoryError"


def test_many_processes_together_are_killed_for_their_memory(enter):
    code = """
        for _ in range(8):
            if os.fork() == 0:
                hoard = bytearray(os.urandom(1 << 20)) * 64
                time.sleep(100)
        time.sleep(100)
    """
    with enter(code, limits=Limits(memory=256 * MiB)) as box:
        with pytest.raises(SandboxDied, match="memory"):
            box.receive(10)
        with pytest.raises(SandboxDied):
            box.receive(1)


def test_forks_that_share_their_memory_are_not_counted_twice(enter):
    code = """
        hoard = bytearray(os.urandom(1 << 20)) * 64
        for _ in range(8):
            if os.fork() == 0:
                time.sleep(100)
        time.sleep(0.8)
        say("alive")
    """
    with enter(code, limits=Limits(memory=256 * MiB)) as box:
        assert json.loads(box.receive(10)) == "alive"


def test_a_million_empty_files_are_noticed(enter):
    code = """
        for i in range(1_000_000):
            os.mknod(f"/tmp/{i}")
    """
    with enter(code) as box, pytest.raises(SandboxDied, match="files"):
        box.receive(10)


def test_full_sockets_are_noticed(enter):
    code = """
        kept = []
        for _ in range(100):
            kept += socket.socketpair()
            kept[-1].setblocking(False)
            outcome(lambda: [kept[-1].send(bytes(30000)) for _ in range(100)])
        time.sleep(100)
    """
    with enter(code) as box, pytest.raises(SandboxDied, match="sockets"):
        box.receive(10)


def test_everything_inside_is_first_in_line_for_the_oom_killer(ask):
    code = """
        reader, writer = os.pipe()
        if os.fork() == 0:
            os.write(writer, open("/proc/self/oom_score_adj").read().encode())
            os._exit(0)
        say([open("/proc/self/oom_score_adj").read().strip(), os.read(reader, 9).decode().strip()])
    """
    assert ask(code) == ["1000", "1000"]


# --- the channel ----------------------------------------------------------------------------------------------------


def test_silence_ends_at_the_deadline(enter):
    with enter("time.sleep(100)") as box:
        start = time.monotonic()
        with pytest.raises(SandboxTimeout):
            box.receive(0.5)
        assert 0.4 < time.monotonic() - start < 5  # ten times the limit, on a machine that has other things to do


def test_dribbling_ends_at_the_deadline(enter):
    code = """
        channel.send((1 << 20).to_bytes(8, "big"))
        while True:
            channel.send(b"x")
            time.sleep(0.001)
    """
    with enter(code) as box:
        start = time.monotonic()
        with pytest.raises(SandboxTimeout):
            box.receive(0.5)
        assert 0.4 < time.monotonic() - start < 5  # ten times the limit, on a machine that has other things to do


def test_not_listening_does_not_block_the_judge(enter):
    with enter("time.sleep(100)") as box:
        start = time.monotonic()
        with pytest.raises(SandboxTimeout):
            box.send(bytes(16 * MiB), timeout=0.5)
        assert 0.4 < time.monotonic() - start < 5  # ten times the limit, on a machine that has other things to do


def test_stopping_itself_ends_at_the_deadline(enter):
    with enter("os.kill(os.getpid(), signal.SIGSTOP)") as box:
        pids = inside(box)
        with pytest.raises(SandboxTimeout):
            box.receive(0.5)
    assert gone(pids)


@pytest.mark.parametrize("length", [sandbox.MAX_FRAME + 1, 2**63, 2**64 - 1])
def test_an_oversized_frame_is_refused_before_it_is_read(enter, length):
    with enter(f"channel.send(({length}).to_bytes(8, 'big')); time.sleep(100)") as box, pytest.raises(SandboxGarbage):
        box.receive(5)


def test_half_a_frame_is_a_death_not_an_answer(enter):
    with (
        enter("channel.send((100).to_bytes(8, 'big') + b'half'); os._exit(3)") as box,
        pytest.raises(SandboxDied, match="status 3"),
    ):
        box.receive(5)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("sys.exit(5)", "status 5"),
        ("raise ValueError", "status 1"),
        ("os.abort()", "SIGABRT"),
        ("ctypes.string_at(0)", "SIGSEGV"),
        ("channel.close(); time.sleep(100)", "closed its connection"),
        ("os.dup2(os.open('/dev/null', os.O_RDWR), channel.fileno()); time.sleep(100)", "closed its connection"),
    ],
)
def test_a_death_says_how(enter, code, text):
    with enter(code) as box:
        with pytest.raises(SandboxDied, match=text):
            box.receive(5)
        with pytest.raises(SandboxDied):
            box.send(b"more", timeout=5)


def test_passed_descriptors_are_dropped(enter):
    code = """
        for _ in range(50):
            socket.send_fds(channel, [(1).to_bytes(8, "big") + b"x"], [0, 1, 2])
        time.sleep(100)
    """
    with enter(code) as box:
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(50):
            assert box.receive(5) == b"x"
        assert len(os.listdir("/proc/self/fd")) == before


def test_nothing_printed_reaches_the_graders_output(enter, capfd):
    code = r"""
        line = "::set-output name=score::100\n::error::forged\n"
        print(line, flush=True)
        print(line, file=sys.stderr, flush=True)
        sys.__stdout__.write(line)
        for target in ("/dev/stdout", "/dev/stderr", "/dev/tty", "/dev/console", "/proc/1/fd/0", "/proc/1/fd/1", "/proc/1/fd/2"):
            outcome(lambda: os.write(os.open(target, os.O_WRONLY | os.O_NONBLOCK), line.encode()))
        say(1)
        sys.exit(line)
    """
    with enter(code) as box:
        box.receive(5)
        with pytest.raises(SandboxDied):
            box.receive(5)
    assert capfd.readouterr() == ("", "")


# --- leaving --------------------------------------------------------------------------------------------------------


def test_a_daemon_is_gone_after_close(enter):
    code = """
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                for number in range(1, 64):
                    if number not in (signal.SIGKILL, signal.SIGSTOP, 32, 33):
                        signal.signal(number, signal.SIG_IGN)
                channel.close()
                time.sleep(100)
            os._exit(0)
        os.wait()
        say(os.getpid())
    """
    box = enter(code)
    with box:
        box.receive(5)
        with pytest.raises(SandboxDied):
            box.receive(5)
    box.close()
    box.close()
    assert not [p for p in psutil.process_iter(["cmdline"]) if f"/course/{box.script.name}" in " ".join(p.info["cmdline"] or [])]

    with enter(textwrap.dedent(code) + "time.sleep(100)\n") as box:
        box.receive(5)
        pids = inside(box)
        assert len(pids) >= 3
    assert gone(pids, within=0)


def test_everything_goes_when_the_grader_is_killed(tmp_path):
    script = tmp_path / "sleeper.py"
    script.write_text("import os, time; os.fork(); os.setsid() if os.getpid() != 2 else None; time.sleep(100)")
    grader = f"""
import sys, time
from pathlib import Path
from autograder.grading.sandbox import Sandbox
with Sandbox(Path({str(script)!r})) as box:
    time.sleep(0.3)
    print(*[process.pid for process in box._tree()], flush=True)
    time.sleep(100)
"""
    process = subprocess.Popen([sys.executable, "-c", grader], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    with process:
        pids = [int(pid) for pid in process.stdout.readline().split()]
        assert len(pids) >= 3
        process.kill()
    assert gone(pids)


def test_a_sandbox_in_a_thread_lives_as_long_as_its_thread(enter):
    answers = []

    def work():
        with enter("say(hear().decode())") as box:
            box.send(b"hello")
            answers.append(box.receive(5))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert answers == [b'"hello"']


# --- what is handed in ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["link", "broken", "folder", "fifo", "missing", "device"])
def test_only_regular_files_are_handed_in(enter, tmp_path, kind):
    path = tmp_path / "given"
    make = {
        "link": lambda: path.symlink_to("/etc/passwd"), "broken": lambda: path.symlink_to("/nowhere"), "folder": path.mkdir,
        "fifo": lambda: os.mkfifo(path), "missing": lambda: None,
    }  # fmt: skip
    path = Path("/dev/zero") if kind == "device" else path
    make.get(kind, lambda: None)()
    for trusted in (False, True):
        with pytest.raises(ValueError, match="cannot hand"), enter("say(1)", files={"given": path}, trusted=trusted):
            pass


@pytest.mark.parametrize("name", ["/etc/passwd", "../out", "a/../../out", "", ".", "a\0b", "a//b", "./a"])
def test_a_name_cannot_lead_out_of_work(enter, name):
    with pytest.raises(ValueError, match="not a plain relative name"):
        enter("say(1)", files={name: Path(__file__)})


def test_odd_names_are_only_names(ask, tmp_path):
    names = ["--bind", "a b\n", "=x", "ünïcode", "\udcff", "-"]
    (tmp_path / "given").write_text("x")
    assert sorted(ask("say(sorted(os.listdir()))", files=dict.fromkeys(names, tmp_path / "given"))) == sorted(names)


def test_more_files_than_fit_are_refused(enter, tmp_path):
    with open(tmp_path / "given", "wb") as file:
        file.truncate(sandbox.MAX_FILES_SIZE + 1)
    with pytest.raises(ValueError, match="256 MiB"), enter("say(1)", files={"given": tmp_path / "given"}):
        pass
    with pytest.raises(ValueError, match="at most"):
        enter("say(1)", files={str(number): tmp_path / "given" for number in range(sandbox.MAX_FILES + 1)})


def test_a_missing_package_is_ours_not_the_learners(enter_anew, monkeypatch):
    monkeypatch.setattr(bubblewrap, "LEARNER_PACKAGES", ("numpy", "no-such-package"))
    for cached in (bubblewrap.packages, bubblewrap.host_mounts):
        cached.cache_clear()
    try:
        with pytest.raises(SandboxUnavailable, match="no-such-package not installed"), enter_anew("say(1)"):
            pass
    finally:
        for cached in (bubblewrap.packages, bubblewrap.host_mounts):
            cached.cache_clear()


def test_a_large_file_handed_in_does_not_use_up_the_learners_space(ask, tmp_path):
    (tmp_path / "weights").write_bytes(bytes(20 * MiB))
    code = f"""
        with open("mine", "wb") as file:
            file.write(bytes({7 * MiB}))
        say(os.path.getsize("weights"))
    """
    assert ask(code, files={"weights": tmp_path / "weights"}, limits=Limits(work=8 * MiB)) == 20 * MiB


# --- where it does not work -----------------------------------------------------------------------------------------


def test_probe_finds_nothing_wrong_here():
    assert sandbox.probe() == []
    sandbox.require()


def test_without_bubblewrap_it_refuses_and_says_how_to_get_it(enter_anew, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(SandboxUnavailable, match="apt install bubblewrap"), enter_anew("say(1)"):
        pass
    with pytest.raises(SandboxUnavailable, match="apt install bubblewrap"):
        sandbox.require()


@pytest.mark.parametrize(
    ("complaint", "advice"),
    [
        ("bwrap: setting up uid map: Permission denied", "user namespaces must be allowed"),
        ("bwrap: Unknown option --disable-userns", "0.8 or newer"),
        ("bwrap: Can't mount proc on /newroot/proc: Operation not permitted", "hides parts of /proc"),
    ],
)
def test_a_failing_bubblewrap_is_ours_and_explained(enter_anew, monkeypatch, tmp_path, complaint, advice):
    fake = tmp_path / "bin" / "bwrap"
    fake.parent.mkdir()
    fake.write_text(f'#!/bin/sh\necho "{complaint}" >&2\nexit 1\n')
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{fake.parent}:{os.environ['PATH']}")
    monkeypatch.setattr(bubblewrap, "_kernel", lambda name: "")
    with pytest.raises(SandboxUnavailable, match=advice) as caught, enter_anew("say(1)"):
        pass
    assert complaint in str(caught.value)


def test_apparmor_is_named_where_it_is_to_blame(monkeypatch):
    monkeypatch.setattr(bubblewrap, "_kernel", lambda name: "1" if "apparmor" in name else "")
    assert "sysctl kernel.apparmor_restrict_unprivileged_userns=0" in bubblewrap.explain(
        "bwrap: setting up uid map: Permission denied"
    )


def test_signals_to_the_graders_group_do_not_reach_the_sandbox(enter):
    with enter("hear(); say(os.getpid())") as box:
        assert inside(box) and all(os.getpgid(pid) != os.getpgrp() for pid in inside(box))


@pytest.fixture
def strict_umask():
    before = os.umask(0o077)
    yield
    os.umask(before)


def test_the_probe_works_under_any_umask(strict_umask):
    assert sandbox.probe() == []


def test_a_script_that_only_root_can_read_is_named_with_the_mend(strict_umask, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    script = tmp_path / "private.py"
    script.write_text("")
    with pytest.raises(SandboxUnavailable, match=f"only root can read .*private.py.*chmod -R go.rX {tmp_path}"), Sandbox(script):
        pass
