"""Entry point of the command ``aquaflow``, and of ``python -m aquaflow``."""

from __future__ import annotations

import signal


def main() -> None:
    """Run a command; until it is loaded, Ctrl-C ends the process without a word."""
    heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not in a background
    if heeded:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from aquaflow.cli import main as run

    if heeded:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


if __name__ == "__main__":
    main()
