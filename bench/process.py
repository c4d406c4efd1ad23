"""Runs an external program: logs its output, reads its progress, and terminates its process group on exit."""

from __future__ import annotations

import math
import os
import re
import select
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from .errors import HeadbenchError, shortened

KEPT = (
    *("PATH", "HOME", "USER", "LANG", "LC_ALL", "TMPDIR", "XDG_CACHE_HOME", "XDG_RUNTIME_DIR"),
    *("LD_LIBRARY_PATH", "CUDA_HOME", "CUDA_PATH", "CUDA_VISIBLE_DEVICES", "CUDA_DEVICE_ORDER"),
    *("NVIDIA_VISIBLE_DEVICES", "NVIDIA_DRIVER_CAPABILITIES", "TORCH_EXTENSIONS_DIR", "TORCH_HOME"),
)
"""Environment variables passed on to a program, without those of the current interpreter."""

GIVEN = {"PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": "1", "TQDM_MININTERVAL": "1"}
"""Additional variables: unbuffered output, and no caches in its folder."""

LAST_LINES, LONGEST_LINE = 12, 2_000
LEFT_IN_PIPE = 2**20
"""Maximum bytes read after the program has ended; its own output is within the pipe's 64 KiB."""
REDRAWN_EVERY_S = 30.0
"""Seconds between logged lines of a progress bar that redraws its line."""
PATIENCE_S = 10.0
"""Seconds between the request to terminate and the kill of a program."""

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class ProgramError(HeadbenchError):
    """An external program failed or did not write the expected output."""


@dataclass(frozen=True)
class ProgramEnd:
    """Result of a program: exit code (negative: signal), last lines of output, and log file."""

    code: int
    lines: tuple[str, ...]
    log: Path

    def error(self, what: str) -> ProgramError:
        """The error with the program's last lines."""
        last = shortened(" | ".join(self.lines), 700) or "none"
        return ProgramError(f"{what.rstrip('.')}. Its last lines: {last}. All of them: {self.log}.")


def described(code: int) -> str:
    """An exit code as text."""
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
    hours: float | None = None,
) -> ProgramEnd:
    """Run a command in ``folder`` until it ends; its output, both streams, is appended to ``log``.

    Its process group is terminated when it ends or this call is interrupted. A process that keeps the output open is
    not waited for.

    Parameters
    ----------
    on_line : Callable
        Called with every line, and with every update of a line that the program redraws.
    variables : Mapping[str, str] | None
        Environment variables in addition to `environment`.
    held : IO[str] | None
        An open file that the program inherits, so that a lock on it lasts as long as the program.
    hours : float | None
        Time limit; None for none.
    """
    until = math.inf if hours is None else time.monotonic() + 3600 * hours
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
            in_time = _follow(process, stream, last, on_line, until)
        finally:
            _end_group(process)
    ended = ProgramEnd(process.wait(), tuple(last), log)
    if not in_time:
        raise ended.error(
            f"{command[0]} was ended after {hours:g} hours, the limit of the setting time_limit_hours"
        )
    return ended


def _follow(
    process: subprocess.Popen[bytes],
    log: IO[bytes],
    last: deque[str],
    on_line: Callable[[str], None],
    until: float,
) -> bool:
    """Log the output of a program until it ends; False if it runs longer than ``until``."""
    drawn = -REDRAWN_EVERY_S
    for line, redrawn in _lines(_output(process, until)):
        on_line(line)
        if last and redrawn and last[-1].split(":")[0] == line.split(":")[0]:
            last[-1] = line
        elif line:
            last.append(line)
        now = time.monotonic()
        if redrawn and now - drawn < REDRAWN_EVERY_S:
            continue
        drawn = now if redrawn else drawn
        log.write(line.encode() + b"\n")
        log.flush()
    return process.poll() is not None


def _output(process: subprocess.Popen[bytes], until: float) -> Iterator[bytes]:
    """Output of a program until it ends or ``until``; another process may keep the pipe open for longer."""
    assert process.stdout is not None
    descriptor, left, is_open = process.stdout.fileno(), LEFT_IN_PIPE, True
    while left > 0 and time.monotonic() < until:
        ended = process.poll() is not None  # before the pipe is looked at, so that the last output is read
        if not is_open and not ended:
            time.sleep(0.05)
        ready = is_open and select.select([descriptor], [], [], 0.0 if ended else 0.2)[0]
        if ready:
            chunk = os.read(descriptor, 1 << 16)
            is_open = bool(chunk)
            left -= len(chunk) if ended else 0
            yield chunk
        elif ended:
            return


def _lines(chunks: Iterator[bytes]) -> Iterator[tuple[str, bool]]:
    """Lines, and whether each is overwritten by the next; memory is bounded."""
    rest = b""
    for chunk in chunks:
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
            # Processes stay in their group until their exit code is read.
            if process.poll() is not None:
                with suppress(ChildProcessError):
                    os.waitpid(-process.pid, os.WNOHANG)
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
