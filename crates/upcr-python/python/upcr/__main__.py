"""``python -m upcr``: the command line, the same as the binary ``upcr``."""

import signal
import sys

from . import _upcr


def main() -> int:
    """Runs the command line and returns its exit status."""
    # Python's handler would only be called after the command's end.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _upcr.main(["upcr", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
