"""Scripts that one server forks find nothing of one another: attacks in pairs, where the first leaves something for the second to find."""

import json
import os
import subprocess
import sys
import textwrap
from contextlib import ExitStack, contextmanager

import psutil
import pytest

from autograder.grading import forking, judge, sandbox
from autograder.grading.forking import ForkServer, Refused
from autograder.grading.sandbox import Sandbox, SandboxDied, SandboxUnavailable
from autograder.paths import COURSE_LIB, ROOT
from tests.autograder.grading.inside import PRELUDE


@pytest.fixture(scope="module")
def server():
    """With torch and the course's library loaded, as the judge has it."""
    made = ForkServer([COURSE_LIB])
    yield made
    made.close()


@pytest.fixture
def enter(tmp_path, server):
    """enter(code, **arguments of Sandbox) → an unopened Sandbox that the server forks."""

    def make(code, by=server, **arguments):
        script = tmp_path / f"script{len(list(tmp_path.iterdir()))}.py"
        script.write_text(PRELUDE + textwrap.dedent(code))
        return Sandbox(script, server=by, **arguments)

    return make


def told(box, timeout=30.0):
    return json.loads(box.receive(timeout))


def test_nothing_that_one_leaves_is_there_for_the_next(enter, tmp_path):
    (tmp_path / "handed-in.txt").write_text("mine")
    leave = """
        import subprocess, torch
        from course_lib.checks import observing
        for folder in ("/tmp", "/work", "/dev/shm"):
            with open(f"{folder}/left", "w") as file:
                file.write("found")
        torch.tensor = observing.observe = None
        torch.manual_seed(12345)
        torch.set_default_dtype(torch.float64)
        sys.modules["left_behind"] = sys
        os.environ["LEFT"] = "found"
        os.umask(0o777)
        os.nice(5)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.setitimer(signal.ITIMER_REAL, 60)
        for _ in range(3):
            if os.fork() == 0:
                os.setsid()
                time.sleep(60)
        say("left")
    """
    find = """
        import torch
        from course_lib.checks import observing
        mask = os.umask(0)
        say([
            [os.listdir(folder) for folder in ("/tmp", "/work", "/dev/shm")],
            [callable(torch.tensor), callable(observing.observe), str(torch.get_default_dtype()), torch.initial_seed()],
            ["left_behind" in sys.modules, os.environ.get("LEFT"), mask, os.getpriority(os.PRIO_PROCESS, 0)],
            [signal.getsignal(signal.SIGTERM) == signal.SIG_DFL, signal.getitimer(signal.ITIMER_REAL)[0]],
            sorted(int(pid) for pid in os.listdir("/proc") if pid.isdigit()),
        ])
    """
    with enter(find) as box:
        before = told(box)
    with enter(leave, files={"handed-in.txt": tmp_path / "handed-in.txt"}) as box:
        assert told(box) == "left"
    with enter(find) as box:
        after = told(box)
    assert before == after
    assert after[0] == [[], [], []] and after[4] == [1, 2]


def test_two_at_a_time_cannot_meet(enter):
    """Abstract sockets, ports, pseudo-terminals and processes are of a namespace's own; and what one signals is its own."""
    listen = """
        waiting = [socket.socket(socket.AF_UNIX), socket.socket()]
        waiting[0].bind("\\0meeting")
        waiting[1].bind(("127.0.0.1", 47011))
        for one in waiting:
            one.listen()
        leader, follower = os.openpty()
        say([os.ttyname(follower), os.readlink("/proc/self/ns/pid"), os.readlink("/proc/self/ns/mnt")])
        time.sleep(60)
    """
    meet = """
        abstract, port = socket.socket(socket.AF_UNIX), socket.socket()
        found = [outcome(abstract.connect, "\\0meeting"), outcome(port.connect, ("127.0.0.1", 47011))]
        found += [os.listdir("/dev/pts"), os.readlink("/proc/self/ns/pid"), os.readlink("/proc/self/ns/mnt")]
        for number in (*range(3, 400), -1):
            outcome(os.kill, number, signal.SIGKILL)
        say(found)
    """
    with enter(listen) as one, enter(meet) as two:
        terminal, *namespaces = told(one)
        assert terminal == "/dev/pts/0"
        abstract, port, terminals, *others = told(two)
        assert (abstract, port) == ("ECONNREFUSED", "ECONNREFUSED") and terminals == ["ptmx"]
        assert not set(namespaces) & set(others)
        assert len(one._tree()) == 2  # and lives


def test_no_page_is_shared_for_writing(enter):
    code = """
        say([line for line in open("/proc/self/maps") if line.split()[1][3] == "s" and "w" in line.split()[1]])
    """
    with enter(code) as box:
        assert told(box) == []


def test_the_servers_memory_holds_nothing_of_a_submission(enter, tmp_path):
    """Its children inherit all of it; so one of them looks for the name and the text of a file that another was given, and its script."""
    words = [b"a-name-as-canary", b"a-text-as-canary", b"a-script-as-canary"]
    given = tmp_path / "given"
    given.write_bytes(words[1])
    first = "# a-script-as-canary\nsay([open('a-name-as-canary').read(), os.getpid()])"
    with enter(first, files={"a-name-as-canary": given}) as box:
        assert told(box) == ["a-text-as-canary", 2]
    reversed_words = [word.decode()[::-1] for word in words]  # or the seeker would find its own script
    seek = f"""
        wanted = {[*reversed_words, "meti-ssecorp-a-saw-siht"]!r}
        planted = bytes(bytearray("this-was-a-process-item", "ascii"))
        found = set()
        with open("/proc/self/mem", "rb", 0) as memory:
            for line in open("/proc/self/maps"):
                span, rights = line.split()[:2]
                if "r" not in rights or line.rstrip().endswith(("[vvar]", "[vsyscall]", "[vvar_vclock]")):
                    continue
                start, end = (int(place, 16) for place in span.split("-"))
                while start < end:
                    memory.seek(start)
                    try:
                        part = memory.read(min(1 << 22, end - start))
                    except OSError:
                        break
                    found |= {{word for word in wanted if bytes(map(ord, reversed(word))) in part}}
                    start += max(len(part) - 64, 1) if len(part) > 64 else (end - start)
        say(sorted(found))
    """
    with enter(seek) as box:
        assert told(box, 120) == ["meti-ssecorp-a-saw-siht"]  # what is there is found


def test_each_has_randomness_of_its_own(enter):
    code = """
        import numpy, random, secrets, tempfile, uuid
        numbers = [random.random(), numpy.random.random(), numpy.random.default_rng().random()]
        say([*numbers, secrets.token_hex(), str(uuid.uuid4()), tempfile.mktemp()])
    """
    seen = []
    for _ in range(2):
        with enter(code) as box:
            seen.append(told(box))
    assert not set(seen[0]) & set(seen[1])


@pytest.mark.parametrize(
    "end", ["os.kill(1, 11); os.kill(os.getpid(), 11)", "ctypes.string_at(0)", "bytearray(8 << 30)", "os._exit(0)", "os.abort()"]
)
def test_the_server_outlives_whatever_it_has_forked(enter, end):
    with enter(f"say('begun')\n{end}\n") as box:
        assert told(box) == "begun"
        with pytest.raises(SandboxDied):
            box.receive(20)
    with enter("import torch\nsay(float(torch.ones(3).sum()))") as box:
        assert told(box) == 3.0


@contextmanager
def process_of(server):
    """The process that forks, above the keepers."""
    yield next(one for one in psutil.Process(server._process.pid).children(recursive=True) if "python" in one.name())


def test_process_1_has_the_filter_and_the_limits_of_its_script(enter):
    """They share a user, so a script can write another program into it."""
    code = """
        def of(pid):
            status = dict(line.split(":", 1) for line in open(f"/proc/{pid}/status"))
            limits = open(f"/proc/{pid}/limits").read()
            return [status["Seccomp"].strip(), status["CapEff"].strip(), limits, open(f"/proc/{pid}/oom_score_adj").read()]
        say([of("self"), of(1)])
    """
    with enter(code) as box:
        script, first = told(box)
    assert script == first and first[0] == "2"


def test_no_descriptor_of_the_hosts_files_is_left_when_a_script_begins(enter, tmp_path):
    """Not in process 1 either: whoever is the files' owner could open them again for writing."""
    (tmp_path / "given").write_text("x")
    code = """
        for number in os.listdir("/proc/1/fd"):
            target = outcome(os.readlink, f"/proc/1/fd/{number}").strip("'").partition(":")[0]
            assert target in ("/dev/null", "pipe", "socket", "ENOENT"), target  # first may not have closed its own yet
        say("none")
    """
    for _ in range(5):
        with enter(code, files={"given": tmp_path / "given"}) as box:
            assert told(box) == "none"


def test_many_files_with_long_names_are_handed_over(enter, tmp_path):
    (tmp_path / "given").write_text("x")
    files = {"/".join([f"{number:03}" + "é" * 100] * 8): tmp_path / "given" for number in range(sandbox.MAX_FILES)}
    with enter("say(len(os.listdir()))", files=files) as box:
        assert told(box) == sandbox.MAX_FILES


def test_a_server_that_gets_no_process_refuses_one_request_and_goes_on(enter, tmp_path):
    fails = tmp_path / "fails_once.py"
    fails.write_text("""
import errno, os
server, fork, left = os.getpid(), os.fork, [True, False, True]
def scarce():
    if os.getpid() == server and not left.pop(0):
        raise OSError(errno.EAGAIN, "no process")
    return fork()
os.fork = scarce
""")
    own = ForkServer([fails], preload=("fails_once",))
    with enter("say(1)\ntime.sleep(60)", by=own) as box:
        assert told(box) == 1
        with pytest.raises(SandboxUnavailable, match="does not answer"), enter("say(2)", by=own):
            pass
        with enter("say(3)", by=own) as other:
            assert told(other) == 3
    own.close()


def test_a_server_that_hangs_is_given_up_in_time(monkeypatch, tmp_path):
    """Whether or not the submission has files: it has not heard of them."""
    monkeypatch.setattr(forking, "ANSWER_TIMEOUT", 0.5)
    shared = forking.Shared(lambda: ForkServer([COURSE_LIB], preload=()))
    monkeypatch.setattr(forking, "course", shared)
    server = shared.get()
    (tmp_path / "given").write_text("x")
    run = judge._Run.__new__(judge._Run)
    run._trusted, run._wall = False, "bubblewrap"
    with process_of(server) as process, ExitStack() as stack:
        process.suspend()
        assert run._begun(stack, {"given": tmp_path / "given"}).server is None
        process.resume()
    assert "does not answer" in shared.given_up and shared.get() is None
    server.close()


def test_a_keeper_that_hangs_does_not_keep_the_judge(enter):
    with enter("say(1); time.sleep(60)") as box:
        told(box)
        processes = [box._root, *box._tree()]
        box._root.suspend()
    assert psutil.wait_procs(processes, timeout=10)[1] == []


@pytest.mark.parametrize("stage", ["loading", "ready", "forked"])
def test_everything_goes_when_the_grader_is_killed(tmp_path, stage):
    slow = tmp_path / "slow.py"
    slow.write_text("import time; time.sleep(1)")
    script = tmp_path / "sleeper.py"
    script.write_text("import os, time; os.fork(); os.setsid() if os.getpid() != 2 else None; time.sleep(100)")
    grader = f"""
import time
from pathlib import Path
import psutil
from autograder.grading.forking import ForkServer
from autograder.grading.sandbox import Sandbox
server = ForkServer([Path({str(slow)!r})], preload=["slow"])
stage = {stage!r}
if stage != "loading":
    server.wait_until_ready()
if stage == "forked":
    box = Sandbox(Path({str(script)!r}), server=server).__enter__()
time.sleep(0.3)
print(*[process.pid for process in psutil.Process().children(recursive=True)], flush=True)
time.sleep(100)
"""
    with subprocess.Popen([sys.executable, "-c", grader], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        processes = [psutil.Process(int(pid)) for pid in process.stdout.readline().split()]
        assert len(processes) >= (5 if stage == "forked" else 2)
        process.kill()
    assert [one for one in psutil.wait_procs(processes, timeout=30)[1] if one.status() != psutil.STATUS_ZOMBIE] == []


def test_neither_the_judge_nor_the_server_keeps_anything_of_what_has_ended(enter, server):
    def kept():
        with process_of(server) as process:
            psutil.wait_procs(process.children(), timeout=10)
            return process.num_fds(), len(process.children()), len(os.listdir("/proc/self/fd"))

    counts = []
    for _ in range(5):
        with enter("say(1)") as box:
            told(box)
        counts.append(kept())
    assert set(counts[1:]) == {counts[1]} and counts[1][1] == 0


def test_what_is_forked_ends_with_its_sandbox_and_its_keeper_and_outlives_its_server(enter):
    sleep = """
        for _ in range(2):
            if os.fork() == 0:
                os.setsid()
                break
        say(os.getpid())
        if os.getpid() == 2:
            channel.recv(1)
            say("alive")
        time.sleep(100)
    """
    own = ForkServer([], preload=())
    for how in ("close", "keeper", "server"):
        with enter(sleep, by=own) as box:
            told(box)
            processes = box._tree()
            assert len(processes) >= 2
            if how == "keeper":
                box._root.kill()
                assert psutil.wait_procs(processes, timeout=10)[1] == []
            elif how == "server":
                own.close()
                box._socket.send(b"?")
                while (said := told(box)) != "alive":
                    assert isinstance(said, int)
        assert psutil.wait_procs(processes, timeout=10)[1] == [], how


def test_a_death_is_told_as_of_any_other_process(enter):
    for code, text in (
        ("os._exit(7)", "status 7"),
        ("os.kill(os.getpid(), 9)", "SIGKILL"),
        ("channel.close(); time.sleep(60)", "closed"),
    ):
        with enter(code) as box, pytest.raises(SandboxDied, match=text):
            box.receive(20)


def test_a_further_process_costs_little_memory(enter, server):
    """By how much the proportional set size of all together grows: what they share counts once."""
    code = """
        import torch
        say(float(torch.ones(3).sum()))
        time.sleep(100)
    """

    def used():
        return sum(sandbox._share(one) for one in psutil.Process(server._process.pid).children(recursive=True))

    with enter(code) as one:
        told(one)
        alone = used()
        with enter(code) as two:
            told(two)
            assert used() - alone < 40 << 20


def test_a_server_that_cannot_start_says_why(tmp_path):
    with pytest.raises(Refused, match="no_such_module"):
        ForkServer([], preload=("no_such_module",)).wait_until_ready()
    threads = tmp_path / "has_threads.py"
    threads.write_text("import threading, time; threading.Thread(target=time.sleep, args=(60,), daemon=True).start()")
    with pytest.raises(Refused, match="started threads"):
        ForkServer([threads], preload=("has_threads",)).wait_until_ready()


def test_where_it_fails_the_judge_begins_anew(monkeypatch):
    shared = forking.Shared(lambda: ForkServer([], preload=("no_such_module",)))
    monkeypatch.setattr(forking, "course", shared)
    run = judge._Run.__new__(judge._Run)
    run._trusted, run._wall = False, "bubblewrap"
    with ExitStack() as stack:
        box = run._begun(stack, {})
        assert box.server is None
    assert "no_such_module" in shared.given_up and shared.get() is None


def test_a_server_that_stops_working_is_given_up_and_what_it_has_forked_lives(monkeypatch, enter):
    shared = forking.Shared(lambda: ForkServer([COURSE_LIB], preload=()))
    monkeypatch.setattr(forking, "course", shared)
    server = shared.get()
    monkeypatch.setattr(server, "fork", lambda *_: (_ for _ in ()).throw(Refused("it does not answer")))
    run = judge._Run.__new__(judge._Run)
    run._trusted, run._wall = False, "bubblewrap"
    for refusals in range(1, forking.PATIENCE + 1):
        with ExitStack() as stack:
            assert run._begun(stack, {}).server is None
        assert (shared.get() is None) == (refusals == forking.PATIENCE)
    assert "does not answer" in shared.given_up
    monkeypatch.undo()
    with enter("say(1)", by=server) as box:
        assert told(box) == 1
    server.close()


def test_a_forked_process_imports_torch_in_no_time(enter):
    """Processor time, as walls move: beside more than a second for a process of its own."""
    with enter("import torch\nsay(float(torch.ones(3).sum()))\ntime.sleep(60)") as box:
        told(box)
        used = [process.cpu_times() for process in (box._root, *box._tree())]
    assert sum(one.user + one.system for one in used) < 0.5


def test_a_server_can_be_started_before_this_process_has_loaded_torch():
    code = "import sys\nfrom autograder.grading import bubblewrap, forking\nbubblewrap.packages()\nprint('torch' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert told.stdout == "False\n"
