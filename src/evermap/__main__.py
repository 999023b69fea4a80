"""`python -m evermap` is the command line."""

from evermap.cli.main import run

if __name__ == "__main__":
    run()
