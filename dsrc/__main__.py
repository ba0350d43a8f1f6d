"""`dsrc` and `python -m dsrc`."""

import sys


def main(args: list[str] | None = None) -> None:
    """Run the command line; a user's mistake is one line on standard error and exit code 2."""
    from dsrc.cli import run
    from sim.errors import UserError

    try:
        run(args)
    except UserError as error:
        sys.stderr.write(f"dsrc: {error}\n")
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        sys.stderr.write("dsrc: interrupted; run the same command again to go on\n")
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
