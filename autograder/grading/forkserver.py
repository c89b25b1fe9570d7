"""Runs inside bubblewrap: has loaded what every submission needs, and forks a sealed process for each that the judge asks for.

Importing torch is most of what a submission costs, so it is done once, here, in a process that never sees a byte of what learners hand
in: a request holds descriptors and nothing else, and what the judge says about a submission is read by its child. `sys.argv[1]` is JSON:
the number of the stream socket to the judge, the path that scripts get, and the modules to load. With each byte on that socket come
three descriptors: the script's channel, a leash, and a pipe for complaints. Of the processes that follow,

  the keeper   stays outside the new namespaces of processes: it holds the leash, kills what it leads to when the judge lets go, and
               says how that ended (one byte, as a shell would put it);
  the first    is process 1 of the namespaces: it makes the file system, drops every privilege, takes the limits and the filter of
               system calls, for the script can write into its memory, and then only reaps;
  the script   has the channel, and nothing else.

Each privilege is given up before the script starts, in the order in which giving up needs them. Whoever changes a line here, look at
what bubblewrap does at that place (https://github.com/containers/bubblewrap), and run tests/autograder/grading/test_sandbox.py.
"""

from __future__ import annotations

import ctypes
import fcntl
import gc
import importlib
import json
import os
import resource
import select
import signal
import socket
import struct
import sys
from contextlib import suppress
from typing import Any, NoReturn

CLONE_NEWNS, CLONE_NEWUTS, CLONE_NEWIPC, CLONE_NEWUSER, CLONE_NEWPID, CLONE_NEWNET = (
    0x20000, 0x4000000, 0x8000000, 0x10000000, 0x20000000, 0x40000000,
)  # fmt: skip
MS_RDONLY, MS_NOSUID, MS_NODEV, MS_NOEXEC, MS_REMOUNT, MS_BIND, MS_REC, MS_PRIVATE = 1, 2, 4, 8, 32, 4096, 16384, 1 << 18
PR_SET_PDEATHSIG, PR_SET_DUMPABLE, PR_SET_SECCOMP, PR_CAPBSET_DROP, PR_SET_NO_NEW_PRIVS = 1, 4, 22, 24, 38
PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL = 47, 4
SECCOMP_MODE_FILTER = 2
CAPABILITY_VERSION_3 = 0x20080522
SIOCSIFFLAGS, IFF_UP_RUNNING = 0x8914, 0x41
NOBODY = 65534
LARGE, MADV_COLLAPSE = 1 << 21, 25  # bytes; the second is in no module of the standard library
MOST_FILES = 250  # descriptors in one message; the kernel allows 253

libc = ctypes.CDLL(None, use_errno=True)


def main() -> NoReturn:
    number, path, preload = json.loads(sys.argv[1])
    become_nobody()
    sys.path += path[:-1]  # the last is where files of a submission lie; here there are none
    gc.disable()
    for module in preload:
        importlib.import_module(module)
    gc.enable()
    gc.freeze()  # or the first collection in a child would copy every page
    if len(os.listdir("/proc/self/task")) != 1:
        sys.exit("a module that was loaded has started threads, which a fork would lose")
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # keepers are nobody's to wait for
    judge = socket.socket(fileno=number)
    judge.send(b"+")
    pages = pages_to_gather()
    while True:
        if pages and not select.select([judge], [], [], 0)[0]:
            libc.madvise(ctypes.c_void_p(pages.pop()), ctypes.c_size_t(LARGE), MADV_COLLAPSE)
            continue
        word, descriptors, _, _ = socket.recv_fds(judge, 1, 3)
        if not word:
            os._exit(0)
        with suppress(OSError):  # no process to be had is one request's trouble, and what runs goes on
            if len(descriptors) == 3 and os.fork() == 0:
                judge.close()
                channel, leash, complaints = descriptors
                keep(channel, leash, complaints, path)
        for descriptor in descriptors:
            os.close(descriptor)


def become_nobody() -> None:
    """Root may mount, and the interpreter may lie where only root gets; from here on neither is needed. Others are themselves already."""
    if os.geteuid() == 0:
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)
        no_capabilities()
        call(libc.prctl, PR_SET_DUMPABLE, 1, 0, 0, 0)  # or its own files in /proc would be root's


def pages_to_gather() -> list[int]:
    """Addresses in this process's memory of what can each become one page of 2 MB, of which a fork lists, and an end lets go, far fewer.

    While nobody asks for a process they are gathered, one every few milliseconds; kernels before Linux 6.1 refuse, and nothing is lost.
    """
    with open("/proc/self/maps", encoding="utf-8") as file:
        areas = [line.split() for line in file]
    found: list[int] = []
    for place, rights, *_, name in (area if len(area) > 5 else [*area, ""] for area in areas):
        begin, end = (int(number, 16) for number in place.split("-"))
        if rights == "rw-p" and name in ("", "[heap]"):
            found += range(-(-begin // LARGE) * LARGE, end // LARGE * LARGE, LARGE)
    return found


# ---- the keeper -----------------------------------------------------------------------------------------------------


def keep(channel: int, leash_number: int, complaints: int, path: list[str]) -> NoReturn:
    """Enter new namespaces, fork their first process, and end it when the judge lets go of the leash."""
    os.dup2(complaints, 2)
    os.close(complaints)
    status = 1
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        leash = socket.socket(fileno=leash_number)
        leash.sendall(b"k")  # the kernel adds who says so, which is how the judge learns of this process
        size = int.from_bytes(leash.recv(8, socket.MSG_WAITALL), "big")
        text, handed, _, _ = socket.recv_fds(leash, size, MOST_FILES)
        while len(text) < size and (more := leash.recv(size - len(text))):  # each reading ends with what descriptors came with
            text += more
        handle = os.pidfd_open(os.getpid())
        unshare(CLONE_NEWUSER | CLONE_NEWNS | CLONE_NEWPID | CLONE_NEWIPC | CLONE_NEWNET | CLONE_NEWUTS)
        first = os.fork()
        if first == 0:
            leash.close()
            be_first(channel, handle, json.loads(text), handed, path)
        for descriptor in (channel, handle, *handed):
            os.close(descriptor)
        os.dup2(os.open(os.devnull, os.O_RDWR), 2)  # or complaints would stay open as long as the script runs
        handle = os.pidfd_open(first)
        if leash_number in select.select([leash_number, handle], [], [])[0]:  # the judge says nothing more, so it is the end
            os.kill(first, signal.SIGKILL)
        status = shells(os.waitpid(first, 0)[1])
        leash.send(bytes([status]))
    except BaseException as error:
        complain(error)
    finally:
        os._exit(status)


def unshare(flags: int) -> None:
    """Enter new namespaces, as nobody."""
    user, group = os.geteuid(), os.getegid()
    call(libc.unshare, flags)
    for name, text in (("setgroups", "deny"), ("uid_map", f"{NOBODY} {user} 1"), ("gid_map", f"{NOBODY} {group} 1")):
        write(f"/proc/self/{name}", text)


def shells(status: int) -> int:
    """How a process ended, as a shell says it."""
    code = os.waitstatus_to_exitcode(status)
    return 128 - code if code < 0 else code


# ---- the first process of the namespaces ----------------------------------------------------------------------------


def be_first(channel: int, keeper: int, given: dict[str, Any], handed: list[int], path: list[str]) -> NoReturn:
    """Make the file system and the network, give up everything, fork the script, and reap."""
    status = 1
    try:
        call(libc.prctl, PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if select.select([keeper], [], [], 0)[0]:
            raise ChildProcessError("the keeper died before its end could be a signal")
        os.close(keeper)
        os.setsid()
        with os.fdopen(handed[0], "rb") as file:
            source = file.read()
        file_system(given["sizes"], given["files"], handed[1:])  # after which no descriptor of the host's files is left
        loopback()
        write("/proc/sys/user/max_user_namespaces", "0")
        drop_privileges()
        for name, value in given["limits"].items():
            resource.setrlimit(getattr(resource, name), (value, value))
        write("/proc/self/oom_score_adj", "1000")
        refuse_calls(bytes.fromhex(given["filter"]))
        script = os.fork()
        if script == 0:
            be_script(channel, given["name"], source, path)
        silence()
        os.closerange(3, 1 << 16)
        while True:
            ended, how = os.wait()
            if ended == script:
                status = shells(how)
                break
    except BaseException as error:  # the judge reads it from the pipe, if it has not begun to run the script
        complain(error)
    finally:
        os._exit(status)


def file_system(sizes: dict[str, int], names: list[str], descriptors: list[int]) -> None:
    """A /proc of these processes alone, and small empty folders where the script may write; /work has the files handed in."""
    call(libc.mount, None, b"/", None, MS_REC | MS_PRIVATE, None)
    call(libc.mount, b"proc", b"/proc", b"proc", MS_NOSUID | MS_NODEV | MS_NOEXEC, None)
    call(libc.mount, b"devpts", b"/dev/pts", b"devpts", MS_NOSUID | MS_NOEXEC, b"newinstance,ptmxmode=0666,mode=620")
    for folder, size in sizes.items():
        call(libc.mount, b"tmpfs", folder.encode(), b"tmpfs", MS_NOSUID | MS_NODEV, f"mode=0755,size={size}".encode())
    for name, descriptor in zip(names, descriptors, strict=True):
        target = os.path.join(os.fsencode("/work"), os.fsencode(name))
        os.makedirs(os.path.dirname(target), exist_ok=True)
        copy = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o444)
        place = 0
        while sent := os.sendfile(copy, descriptor, place, 1 << 24):
            place += sent
        os.close(copy)
        os.close(descriptor)
    os.chdir("/work")


def loopback() -> None:
    """Raise the one interface of a new network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", IFF_UP_RUNNING))


def drop_privileges() -> None:
    """Be nobody for good: no capability, and none to be had by running a program."""
    call(libc.prctl, PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    call(libc.prctl, PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL, 0, 0, 0)
    with open("/proc/sys/kernel/cap_last_cap", encoding="ascii") as file:
        last = int(file.read())
    for capability in range(last + 1):
        call(libc.prctl, PR_CAPBSET_DROP, capability, 0, 0, 0)
    no_capabilities()


def no_capabilities() -> None:
    call(libc.capset, struct.pack("=Ii", CAPABILITY_VERSION_3, 0), bytes(24))


# ---- the script -----------------------------------------------------------------------------------------------------


def be_script(channel: int, name: str, source: bytes, path: list[str]) -> NoReturn:
    """Tell the judge that all that is ours has worked, and run the script."""
    code = compile(source, name, "exec", dont_inherit=True)
    sys.path.append(path[-1])
    sys.argv = [name, str(channel)]
    module = type(sys)("__main__")
    sys.modules["__main__"] = module
    module.__file__ = name
    silence()
    os.closerange(3, channel)
    os.closerange(channel + 1, 1 << 16)
    os.write(channel, b"+")
    status = 1
    try:
        exec(code, vars(module))
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        os._exit(status & 0xFF)


def refuse_calls(program: bytes) -> None:
    """Install a compiled filter of system calls."""
    instructions = ctypes.create_string_buffer(program, len(program))
    filtered = struct.pack("@HP", len(program) // 8, ctypes.addressof(instructions))
    call(libc.prctl, PR_SET_SECCOMP, SECCOMP_MODE_FILTER, filtered, 0, 0)


def silence() -> None:
    """Standard streams lead nowhere: what a learner prints in a CI log could be a workflow command."""
    for standard in (0, 1, 2):
        os.dup2(os.open(os.devnull, os.O_RDWR), standard)


def complain(error: BaseException) -> None:
    os.write(2, f"{type(error).__name__}: {error}".encode(errors="replace"))


def write(path: str, text: str) -> None:
    descriptor = os.open(path, os.O_WRONLY)
    try:
        os.write(descriptor, text.encode())
    finally:
        os.close(descriptor)


def call(function: Any, *arguments: Any) -> None:
    """Call the C library; OSError, with the function's name, if that fails."""
    if function(*arguments) == -1:
        number = ctypes.get_errno()
        raise OSError(number, f"{function.__name__}: {os.strerror(number)}")


if __name__ == "__main__":
    main()
