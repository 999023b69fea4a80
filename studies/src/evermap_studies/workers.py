"""Processes that compute a part of a study."""

from __future__ import annotations

import os
import signal
from types import TracebackType
from typing import Self


class sheltered:  # noqa: N801 (used as a function)
    """Processes that are started in this block never see Ctrl-C, which reaches all processes of a terminal: the one
    that started them decides.
    """

    def __enter__(self) -> Self:
        self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if os.name == "posix" else None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)
