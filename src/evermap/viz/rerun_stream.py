"""What every rerun recording needs: the package itself, and the colours of our figures."""

from __future__ import annotations

from evermap.errors import MissingExtraError


def require_rerun() -> None:
    """Makes sure that rerun-sdk (extra `evermap[rerun]`) can be imported.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        hint = "pip install 'evermap[rerun]'"
        raise MissingExtraError("a rerun scene needs rerun-sdk, which is not installed", hint=hint) from error


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue in [0, 255] of a colour of `style`, `#rrggbb`."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
