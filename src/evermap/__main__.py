"""`python -m evermap`, and the installed command: from the first import on, Ctrl-C is one line and an exit code."""

from evermap import interrupts


def run() -> None:
    """Entry point of the installed command."""
    interrupts.leave_on_signals()
    from evermap.cli.main import run as command_line

    command_line()


if __name__ == "__main__":
    run()
