"""`dsrc` and `python -m dsrc`."""

import errno
import sys

_NO_ACCESS = (errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ENOSPC, errno.ENOTDIR, errno.EROFS)
"""Failures of the file system that lie with the path that was asked for, or with the disk."""


def main(args: list[str] | None = None) -> None:
    """Run the command line; a user's mistake is one line on standard error and exit code 2."""
    from dsrc.cli.main import run
    from sim.errors import UserError

    try:
        run(args)
    except UserError as error:
        sys.stderr.write(f"dsrc: {error}\n")
        raise SystemExit(2) from None
    except OSError as error:
        if error.errno not in _NO_ACCESS or error.filename is None:
            raise
        sys.stderr.write(f"dsrc: {error.filename2 or error.filename}: {error.strerror}\n")
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        sys.stderr.write("dsrc: interrupted; generate, corrupt, train, benchmark and demo go on when started again\n")
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
