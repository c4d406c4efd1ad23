"""Runs an external program: logs its output, reads its progress, and terminates its process group on exit."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ...bench.errors import HeadbenchError, shortened
from ...bench.io.files import flush_renames

KEPT = (
    *("PATH", "HOME", "USER", "LANG", "LC_ALL", "TMPDIR", "XDG_CACHE_HOME", "XDG_RUNTIME_DIR"),
    *("LD_LIBRARY_PATH", "CUDA_HOME", "CUDA_PATH", "CUDA_VISIBLE_DEVICES", "CUDA_DEVICE_ORDER"),
    *("NVIDIA_VISIBLE_DEVICES", "NVIDIA_DRIVER_CAPABILITIES", "TORCH_EXTENSIONS_DIR", "TORCH_HOME"),
)
"""Environment variables passed to a program, without those of the current interpreter."""

GIVEN = {"PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": "1", "TQDM_MININTERVAL": "1"}
"""Additional variables: output is not buffered, and no caches are written to its folder."""

LAST_LINES, LONGEST_LINE = 12, 2_000
LONGEST_LOG = 64 * 2**20
REDRAWN_EVERY_S = 30.0
"""Seconds between logged lines of a progress bar that redraws its line."""
PATIENCE_S = 10.0
"""Seconds between the request to terminate and the kill of a program."""

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class ProgramError(HeadbenchError):
    """An external program failed or did not write the expected output."""


@dataclass(frozen=True)
class ProgramEnd:
    """End of a program: its exit code (negative: the signal), its last lines, and the log file."""

    code: int
    lines: tuple[str, ...]
    log: Path

    def error(self, what: str) -> ProgramError:
        """The error with the program's last lines."""
        last = shortened(" | ".join(self.lines), 700) or "none"
        return ProgramError(f"{what.rstrip('.')}. Its last lines: {last}. All of them: {self.log}.")


def described(code: int) -> str:
    """An exit code in words."""
    if code >= 0:
        return f"ended with exit code {code}"
    name = signal.Signals(-code).name if -code in {*signal.Signals} else f"signal {-code}"
    why = "; the system may have killed it for lack of memory" if -code == signal.SIGKILL else ""
    return f"was ended by {name}{why}"


def environment(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """Environment variables of a program."""
    return {name: os.environ[name] for name in KEPT if name in os.environ} | GIVEN | dict(more or {})


def run_program(
    command: Sequence[str],
    folder: Path,
    log: Path,
    on_line: Callable[[str], None],
    *,
    variables: Mapping[str, str] | None = None,
    held: IO[str] | None = None,
) -> ProgramEnd:
    """Run a command in ``folder`` until it ends; its output, both streams, is appended to ``log``.

    The program and its children are one process group, which is terminated when the program ends or this call is
    interrupted. Files written for it are flushed to disk before, even inside a group of writes.

    Parameters
    ----------
    on_line : Callable
        Called with every line, and with every update of a line that the program redraws.
    variables : Mapping[str, str] | None
        Environment variables in addition to `environment`.
    held : IO[str] | None
        An open file that the program inherits, so that a lock on it lasts as long as the program.

    Raises
    ------
    ProgramError
        The command cannot be started.
    """
    flush_renames()
    with log.open("ab") as stream:
        stream.write(f"$ {' '.join(command)}\n".encode())
        try:
            process = subprocess.Popen(
                command,
                cwd=folder,
                env=environment(variables),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=() if held is None else (held.fileno(),),
            )
        except OSError as error:
            raise ProgramError(f"{command[0]} could not be started: {error.strerror or error}.") from error
        last: deque[str] = deque(maxlen=LAST_LINES)
        try:
            assert process.stdout is not None
            _follow(process.stdout, stream, last, on_line)
            code = process.wait()
        finally:
            _end_group(process)
    return ProgramEnd(code, tuple(last), log)


def _follow(output: IO[bytes], log: IO[bytes], last: deque[str], on_line: Callable[[str], None]) -> None:
    drawn = -REDRAWN_EVERY_S
    for line, redrawn in _lines(output):
        on_line(line)
        if last and redrawn and last[-1].split(":")[0] == line.split(":")[0]:
            last[-1] = line
        elif line:
            last.append(line)
        now = time.monotonic()
        if redrawn and now - drawn < REDRAWN_EVERY_S:
            continue
        drawn = now if redrawn else drawn
        if log.tell() < LONGEST_LOG:
            log.write(line.encode() + b"\n")
            log.flush()


def _lines(output: IO[bytes]) -> Iterator[tuple[str, bool]]:
    """Lines, and whether each is overwritten by the next; memory is bounded."""
    rest = b""
    while chunk := os.read(output.fileno(), 1 << 16):
        *whole, rest = re.split(rb"(\r\n|\n|\r)", rest + chunk)
        for text, end in zip(whole[::2], whole[1::2]):
            yield _readable(text), end == b"\r"
        rest = rest[-LONGEST_LINE:]
    if rest:
        yield _readable(rest), False


def _readable(text: bytes) -> str:
    line = _ESCAPES.sub("", text[-LONGEST_LINE:].decode(errors="replace"))
    return "".join(character if character.isprintable() else " " for character in line).rstrip()


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """Terminate a program and its children, and kill them if necessary."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if not _signal_group(process.pid, number):
            break
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until and _signal_group(process.pid, 0):
            process.poll()  # a dead leader stays in its group until its exit code is read
            time.sleep(0.02)
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def _signal_group(leader: int, number: int) -> bool:
    try:
        os.killpg(leader, number)
    except (ProcessLookupError, PermissionError):
        return False
    return True
