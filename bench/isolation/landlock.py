"""Restricts this process's access to files, network and other processes by Landlock (Linux)."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # numbers of the system calls, the same on every architecture
_PATH_BENEATH, _NO_NEW_PRIVILEGES = 1, 38
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR = 1, 2, 4, 8
_TRUNCATE, _IOCTL = 1 << 14, 1 << 15
_FILE_RIGHTS = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _IOCTL
"""Rights that a rule for a single file may have."""
_READ = _EXECUTE | _READ_FILE | _READ_DIR
_RIGHTS = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 5: (1 << 16) - 1}
"""All file rights by Landlock version; versions in between have those of the previous one."""
_NETWORK = 0b11  # binding and connecting TCP sockets, from version 4
_SCOPES = 0b11  # abstract Unix sockets and signals, from version 6
SYSTEM = (
    "/usr",
    "/bin",
    "/sbin",
    "/lib",
    "/lib32",
    "/lib64",
    "/etc",
    "/opt",
    "/nix",
    "/proc",
    "/sys",
    "/run/nvidia",
)
"""Folders that programs and libraries are read from."""
DEVICES = ("null", "zero", "full", "random", "urandom", "tty", "shm", "nvidia*", "dri", "kfd")
"""Allowed devices: standard devices, shared memory and GPUs, but no disks."""


def devices() -> list[Path]:
    """The `DEVICES` of this machine."""
    return sorted(path for pattern in DEVICES for path in Path("/dev").glob(pattern))


def landlock_version() -> int:
    """Version of Landlock that the kernel offers; 0 for none."""
    if sys.platform != "linux":
        return 0
    return max(0, int(_libc().syscall(_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(1))))


def restrict(read: Iterable[str | Path], write: Iterable[str | Path]) -> int:
    """Restrict this process and all processes that it starts, permanently.

    Parameters
    ----------
    read, write : Iterable[str | Path]
        Files and folders that can be read and executed, and those that can also be changed. Missing ones are skipped.

    Returns
    -------
    int
        Version of Landlock in effect. TCP is restricted from version 4, signals from version 6.
        0: the kernel has no Landlock and nothing is restricted.
    """
    version = landlock_version()
    if not version:
        return 0
    libc = _libc()
    rights = _RIGHTS[max(known for known in _RIGHTS if known <= version)]
    attributes = struct.pack("=QQQ", rights, 0 if version < 4 else _NETWORK, 0 if version < 6 else _SCOPES)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    ruleset = _checked(libc.syscall(_CREATE, attributes, ctypes.c_size_t(size), ctypes.c_uint32(0)))
    for paths, allowed in ((read, _READ), (write, rights)):
        for path in paths:
            try:
                opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
            except OSError:
                continue
            own = allowed if Path(path).is_dir() else allowed & _FILE_RIGHTS
            rule = struct.pack("=Qi", own & rights, opened)
            _checked(libc.syscall(_ADD, ruleset, _PATH_BENEATH, rule, ctypes.c_uint32(0)))
            os.close(opened)
    _checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    _checked(libc.syscall(_RESTRICT, ruleset, ctypes.c_uint32(0)))
    os.close(ruleset)
    return version


def without(roots: Iterable[Path], hidden: Iterable[Path]) -> Iterator[Path]:
    """The folders of ``roots``; one that contains a hidden path is replaced by its entries that do not."""
    hidden = [path.resolve() for path in hidden]
    for root in dict.fromkeys(path.resolve() for path in roots if path.exists()):
        if any(root.is_relative_to(path) for path in hidden):
            continue
        if any(path.is_relative_to(root) for path in hidden):
            with suppress(PermissionError):  # folders that cannot be listed are left out
                yield from without([entry for entry in root.iterdir() if not entry.is_symlink()], hidden)
        else:
            yield root


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _checked(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), "landlock")
    return result
