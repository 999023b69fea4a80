"""`python -m evermap`, and the installed command: from the first import on, Ctrl-C is one line and an exit code."""

import gc

from evermap import interrupts


def run() -> None:
    """Entry point of the installed command."""
    interrupts.leave_on_signals()
    gc.set_threshold(50_000, 20, 50)  # imports leave little garbage: looking for it as often as usual takes 0.3 s
    from evermap.cli.main import run as command_line

    command_line()


if __name__ == "__main__":
    run()
