"""The system calls that a learner's process never needs, as a compiled seccomp filter for `bwrap --seccomp`.

`program() -> bytes` is classic BPF (linux/seccomp.h): another architecture's calls kill the process, the calls listed
below answer EPERM, all others pass. NotImplementedError on a machine whose call numbers are not in the table.
"""

import errno
import platform
import struct

AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

# name: (x86_64, aarch64), from the kernel's syscall tables.
DENIED = {
    # memory that belongs to no process, so that neither RLIMIT_AS nor the memory watchdog sees it
    "memfd_create": (319, 279), "memfd_secret": (447, 447), "shmget": (29, 194), "msgget": (68, 186),
    "semget": (64, 190), "mq_open": (240, 180), "io_uring_setup": (425, 425),
    # keyrings are shared by every process of a user: no namespace separates them
    "add_key": (248, 217), "request_key": (249, 218), "keyctl": (250, 219),
    # looking into, or steering, another process
    "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271), "kcmp": (312, 272),
    # large corners of the kernel that need privileges anyhow: a second lock on the same door
    "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282), "open_by_handle_at": (304, 265),
    "unshare": (272, 97), "setns": (308, 268), "mount": (165, 40), "umount2": (166, 39), "pivot_root": (155, 41),
    "chroot": (161, 51), "open_tree": (428, 428), "move_mount": (429, 429), "fsopen": (430, 430),
    "fsmount": (432, 432), "fspick": (433, 433), "mount_setattr": (442, 442),
}  # fmt: skip

LOAD, JUMP_EQUAL, JUMP_GREATER_EQUAL, RETURN = 0x20, 0x15, 0x35, 0x06
NUMBER, ARCHITECTURE = 0, 4  # offsets in struct seccomp_data
KILL, ALLOW, REFUSE = 0x80000000, 0x7FFF0000, 0x00050000 | errno.EPERM
X32 = 0x40000000  # the x32 ABI on x86_64: the same calls under numbers with this bit


def program() -> bytes:
    machine = platform.machine()
    if machine not in AUDIT_ARCH:
        raise NotImplementedError(f"no system-call filter for a {machine} machine: the sandbox knows {', '.join(AUDIT_ARCH)}")
    numbers = [pair[list(AUDIT_ARCH).index(machine)] for pair in DENIED.values()]
    tests = [(JUMP_GREATER_EQUAL, X32), *((JUMP_EQUAL, number) for number in numbers)]
    code = [(LOAD, 0, 0, ARCHITECTURE), (JUMP_EQUAL, 1, 0, AUDIT_ARCH[machine]), (RETURN, 0, 0, KILL), (LOAD, 0, 0, NUMBER)]
    # A test that holds jumps over the remaining tests and over ALLOW, to REFUSE.
    code += [(test, len(tests) - i, 0, value) for i, (test, value) in enumerate(tests)]
    code += [(RETURN, 0, 0, ALLOW), (RETURN, 0, 0, REFUSE)]
    return b"".join(struct.pack("=HBBI", *instruction) for instruction in code)
