"""The command line: calls the named command, and turns every error into one line and an exit code."""

from __future__ import annotations

import errno
import os
import select
import signal
import sys
import traceback
from importlib.metadata import version

from .errors import ExitCode, HeadbenchError, Interruption
from .machine import limit_threads
from .terminal import prepare_streams, show, wrapped


def main(arguments: list[str] | None = None) -> int:
    """Run a command line, by default the process's own; returns the exit code, one of `ExitCode`."""
    # OpenMP's workers spin by default while they wait, which makes several threads many times slower than one on a
    # busy machine, so let them sleep. The variable is read once, when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    limit_threads()
    prepare_streams()
    words = sys.argv[1:] if arguments is None else arguments
    try:
        try:
            return _call(words)
        except BrokenPipeError:
            if not _reader_has_gone():
                raise
            return ExitCode.OK  # `headbench --help | head -1`: not an error
        finally:
            show(end="")  # flush buffered output while errors can still be reported
    except SystemExit as exited:  # of the parser: help, completion, wrong usage
        return int(exited.code or ExitCode.OK)
    except HeadbenchError as error:
        return _fail(str(error), ExitCode.BAD_INPUT)
    except KeyboardInterrupt as error:
        ended = error if isinstance(error, Interruption) else Interruption(signal.SIGINT)
        return _fail(str(ended), ended.code)
    except OSError as error:
        return _fail(_described(error), ExitCode.BAD_INPUT)
    except Exception:  # noqa: BLE001
        traceback.print_exc()
        return _fail("unexpected error; please report it with the lines above", ExitCode.UNEXPECTED)


def _fail(message: str, code: ExitCode) -> ExitCode:
    print(wrapped(f"headbench: {message}", sys.stderr), file=sys.stderr)
    return code


def _described(error: OSError) -> str:
    """A system error as one line: file, reason and, if it is not obvious, remedy."""
    reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
    if error.errno == errno.EEXIST and os.path.isfile(error.filename or ""):
        reason = "expected a folder, found a file"  # creating a folder fails with this error only if a file is there
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
    remedy = ". Free disk space or allow writing, then start again." if full else ""
    return f"{'' if error.filename is None else f'{error.filename}: '}{reason}{remedy}"


def _reader_has_gone() -> bool:
    """Whether standard output is a pipe whose reader has closed it."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _call(words: list[str]) -> int:
    """Call the command named by the arguments."""
    if words and words[0] in ("--version", "-V", "version"):
        show(f"headbench {version('headbench')}")
        return ExitCode.OK
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    from .commands import call

    return call(words)
