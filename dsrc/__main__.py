"""Entry point of `dsrc` and `python -m dsrc`: exit codes and one-line errors."""

import errno
import os
import sys

_PATH_ERRORS = (errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ENOSPC, errno.ENOTDIR, errno.EROFS)
"""Errors of the file system that are the fault of a path the user gave, or of a full disk."""


def main(args: list[str] | None = None) -> None:
    """Run the command line.

    A user's mistake is one line on standard error and exit code 2, an interrupt exit code 130, a closed pipe 141.
    """
    from dsrc.cli.main import run
    from sim.errors import UserError

    try:
        try:
            run(args)
        finally:
            sys.stdout.flush()
    except UserError as error:
        _end(f"dsrc: {error}\n", 2)
    except BrokenPipeError:
        try:
            sys.stdout.write("\n")
            sys.stdout.flush()
        except BrokenPipeError:  # the reader of standard output, such as `head`, has gone
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise SystemExit(141) from None
        raise
    except OSError as error:
        if error.errno not in _PATH_ERRORS or error.filename is None:
            raise
        _end(f"dsrc: {error.filename2 or error.filename}: {error.strerror}\n", 2)
    except KeyboardInterrupt:
        _end("dsrc: interrupted; generate, corrupt, dataset, model train, benchmark and demo resume\n", 130)


def _end(line: str, code: int) -> None:
    sys.stderr.write(line)
    raise SystemExit(code) from None


if __name__ == "__main__":
    main()
