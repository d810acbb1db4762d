"""The command `ahrsd`: options that every command has, and what an error looks like.

Exit codes: 0 done, 1 done and the answer is no, 2 bad usage or input, 70 a bug, 75 device busy
or absent (docs: README, "Reference").
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from types import TracebackType

import click

from ahrsd import __version__
from ahrsd.cli import LazyGroup
from ahrsd.daemon import logs
from ahrsd.errors import EXIT_DONE, EXIT_INTERNAL, EXIT_USAGE, AhrsdError
from ahrsd.printable import LINE, printable

# Before numpy is loaded. The matrices here are small: further threads spin on a busy machine and
# change the last digits from run to run.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_FULL = (errno.ENOSPC, errno.EDQUOT)  # of the disk to which stdout goes
_INTERRUPTED = 130  # 128 + SIGINT, as every shell reports it


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="ahrsd")
@click.option("-v", "--verbose", count=True, help="Log more: -v events, -vv also the traffic.")
def group(verbose: int) -> None:
    """Keep the magnetometer and gyroscope of a VN-100 calibrated from its own stream."""
    logs.configure(verbose)


class _Bugs:
    """Whatever nobody foresaw leaves as exit code 70 with its traceback, not as a usage error."""

    def __enter__(self) -> None:
        return None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None or not isinstance(error, Exception):
            return
        traceback.print_exception(error)
        click.echo(
            f"ahrsd: internal error ({type(error).__name__}), this is a bug; "
            "please report the lines above with the recording or capture",
            err=True,
        )
        sys.exit(EXIT_INTERNAL)


def _detach_stdout() -> None:
    """The reader has gone: the interpreter's own flush at exit must not complain about it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; always ends in SystemExit."""
    with _Bugs():
        try:
            # not `group.main`: a reader that went away would be exit 1, "the answer is no"
            given = sys.argv[1:] if arguments is None else list(arguments)
            with group.make_context("ahrsd", given) as context:
                group.invoke(context)
            sys.stdout.flush()
        except click.exceptions.Exit as end:
            sys.exit(end.exit_code)
        except click.ClickException as error:
            error.show()
            sys.exit(error.exit_code)
        except (click.Abort, KeyboardInterrupt):
            click.echo("ahrsd: interrupted", err=True)
            sys.exit(_INTERRUPTED)
        except AhrsdError as error:
            for line in str(error).splitlines():
                click.echo(f"ahrsd: {printable(line, LINE)}", err=True)
            sys.exit(error.exit_code)
        except BrokenPipeError:
            _detach_stdout()
            sys.exit(EXIT_DONE)
        except OSError as error:
            if error.errno not in _FULL:
                raise
            _detach_stdout()
            click.echo(f"ahrsd: cannot write: {error.strerror}; make room for it", err=True)
            sys.exit(EXIT_USAGE)
        sys.exit(EXIT_DONE)


if __name__ == "__main__":
    main()
