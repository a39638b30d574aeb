"""What a child may no longer ask of Linux: a network, another program, another process.

A filter of system calls (seccomp) refuses them with the error EPERM. It cannot be taken off, and
nothing that the child starts gets more rights (``no_new_privs``). Reading and writing of files are
left alone.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import platform
import struct
from typing import NamedTuple

SET_NO_NEW_PRIVS = 38
"""First argument of ``prctl``."""
SET_SECCOMP = 22
FILTER_MODE = 2

# Operations of the filter: words of Berkeley's packet filter.
LOAD = 0x20
IS_EQUAL = 0x15
IS_AT_LEAST = 0x35
RETURN = 0x06

# Places in what the filter sees of a call.
NUMBER = 0
MACHINE = 4

ALLOW = 0x7FFF0000
REFUSE = 0x00050000 | errno.EPERM
OTHER_TABLE = 0x40000000
"""From here on the numbers of x86-64 are those of its second table (x32)."""


class Machine(NamedTuple):
    """How a kind of processor names itself and its system calls."""

    name: int  # AUDIT_ARCH
    refused: dict[str, int]


MACHINES = {
    "x86_64": Machine(
        0xC000003E,
        {
            "socket": 41,
            "socketpair": 53,
            "execve": 59,
            "execveat": 322,
            "ptrace": 101,
            "process_vm_readv": 310,
            "process_vm_writev": 311,
            "io_uring_setup": 425,
            "pidfd_getfd": 438,
        },
    ),
    "aarch64": Machine(
        0xC00000B7,
        {
            "socket": 198,
            "socketpair": 199,
            "execve": 221,
            "execveat": 281,
            "ptrace": 117,
            "process_vm_readv": 270,
            "process_vm_writev": 271,
            "io_uring_setup": 425,
            "pidfd_getfd": 438,
        },
    ),
}
"""What is refused, by the numbers of the kernel: new connections (also those that ``io_uring``
makes), new programs, and the memory and files of other processes."""


class _Program(ctypes.Structure):
    """What the kernel takes a filter as (``struct sock_fprog``)."""

    _fields_ = [("length", ctypes.c_ushort), ("words", ctypes.c_void_p)]


def refuse_network_and_programs() -> bool:
    """Refuse this process connections and programs, for good.

    Returns:
        Whether the system does so: a Linux without seccomp, or another processor, does not.

    Example:
        >>> refuse_network_and_programs()  # doctest: +SKIP
        True
    """
    machine = MACHINES.get(platform.machine())
    if machine is None:
        return False
    words = filter_words(machine)
    # kept until the kernel has copied it
    memory = ctypes.create_string_buffer(words, len(words))
    program = _Program(len(words) // 8, ctypes.addressof(memory))
    with contextlib.suppress(OSError, AttributeError):
        prctl = ctypes.CDLL(None, use_errno=True).prctl
        prctl.argtypes = [ctypes.c_int, *[ctypes.c_ulong] * 4]
        address = ctypes.addressof(program)
        is_tied = prctl(SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
        return is_tied and prctl(SET_SECCOMP, FILTER_MODE, address, 0, 0) == 0
    return False


def filter_words(machine: Machine) -> bytes:
    """Return the filter of a machine, as the kernel reads it.

    It refuses all calls that come by the table of another machine.
    """
    refused = (RETURN, 0, 0, REFUSE)
    # operation, how many words to skip where the test holds and where not, value
    words = [
        (LOAD, 0, 0, MACHINE),
        (IS_EQUAL, 1, 0, machine.name),
        refused,
        (LOAD, 0, 0, NUMBER),
        (IS_AT_LEAST, 0, 1, OTHER_TABLE),
        refused,
    ]
    for number in machine.refused.values():
        words += [(IS_EQUAL, 0, 1, number), refused]
    words.append((RETURN, 0, 0, ALLOW))
    return b"".join(struct.pack("<HBBI", *word) for word in words)
