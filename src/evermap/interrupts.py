"""Ctrl-C: where it may stop a program, where it has to wait, and how a command ends by it.

Python raises `KeyboardInterrupt` between any two instructions of the main thread, also inside a function that a C
library has called. There the exception is lost: the program goes on as if nobody had asked, or crashes, because the
library did not get its answer. The just-in-time compiler is such a library: it asks for kept machine code through
a callback of ctypes, and without an answer the kernel's address is 0.

So nothing is raised inside `held` and `watched`, and the command line raises nothing at all: after
`leave_on_signals` a signal removes what is half written, says in one line what was kept, and ends the process.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time

TYPE_CHECKING = False  # as in typing, which takes longer to load than all of this: the first instants count
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType
    from typing import Any, Self

_SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}

_open = {"held": 0, "watched": 0}
_former: dict[int, Any] = {}
_came: list[int] = []
_stops: set[int] = {signal.SIGINT}
_cleanups: list[Callable[[], object]] = []
_kept: dict[str, str] = {}
_exit_code: list[int] = []


class _Block:
    """A `with` block for which the handlers are taken over; blocks may be nested, and those of other threads than the
    main one do nothing, because no signal is ever delivered there.
    """

    kind = "held"

    def __enter__(self) -> Self:
        self._counts = threading.current_thread() is threading.main_thread()
        if self._counts:
            if not any(_open.values()):
                _take_over()
            _open[self.kind] += 1
        return self

    def __exit__(self, *error: object) -> None:
        if self._counts:
            _open[self.kind] -= 1
            _deliver()


class held(_Block):  # noqa: N801 (used as a function)
    """A block that no signal cuts in two; one that comes is delivered at its end."""


class watched(_Block):  # noqa: N801 (used as a function)
    """A loop that says where it may be stopped. A second Ctrl-C does not wait for that, and one that came too late
    for it is delivered at the end.

    Args:
        also: signals that stop it as Ctrl-C does.
    """

    kind = "watched"

    def __init__(self, *also: int) -> None:
        self._also = also

    def __enter__(self) -> Self:
        _stops.update(self._also)
        return super().__enter__()

    def __exit__(self, *error: object) -> None:
        _stops.difference_update(self._also)
        super().__exit__(*error)

    def stop_if_asked(self) -> None:
        """Raise `KeyboardInterrupt` if Ctrl-C came: here nothing is half done."""
        for number in _stops & set(_came):
            _came.remove(number)
            raise KeyboardInterrupt

    def sleep(self, seconds: float) -> None:
        """Sleep, at most until Ctrl-C comes."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0 and signal.SIGINT not in _came:
            time.sleep(min(left, 0.05))


def raises() -> bool:
    """Return whether a signal may raise an exception here; after `leave_on_signals` none does."""
    return signal.getsignal(signal.SIGINT) is not _leave


def _take_over() -> None:
    for number in _SIGNALS:
        handler = signal.getsignal(number)
        if callable(handler):  # neither ignored nor left to the system
            _former[number] = handler
            signal.signal(number, _remember)


def _remember(number: int, frame: FrameType | None) -> None:
    waits = _open["held"] or (number in _stops and number not in _came)
    if not waits:
        _former[number](number, frame)
    elif number not in _came:
        _came.append(number)


def _deliver() -> None:
    """What has waited, to the handlers of before; within a loop that is watched only what need not wait for it."""
    if _open["held"]:
        return
    if not _open["watched"]:
        for number, handler in _former.items():
            signal.signal(number, handler)
        _former.clear()
    due = [number for number in _came if not _open["watched"] or number not in _stops]
    for number in due:
        _came.remove(number)
        signal.raise_signal(number)


class temporary:  # noqa: N801 (used as a function)
    """A block after which nothing is left of something: `remove` is called at its end, or when a signal ends the
    process within it.
    """

    def __init__(self, remove: Callable[[], object]) -> None:
        self._remove = remove

    def __enter__(self) -> Self:
        _cleanups.append(self._remove)
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self._remove()
        finally:
            _cleanups.remove(self._remove)


def kept(place: str | os.PathLike[str], said: str) -> None:
    """Note what a command that is interrupted from now on has to say about a file or folder.

    Args:
        place: the file or folder; where it does not exist any more, nothing is said.
        said: as 'the results are in out'; replaces what was said of this place before.
    """
    _kept[os.fspath(place)] = said


def leave_on_signals() -> None:
    """End this process by Ctrl-C from now on: one line, exit code 130, nothing half written (143 for SIGTERM)."""
    if not raises():
        return
    atexit.register(_end_process)  # the first to be registered is the last to be called
    for number, fallback in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if signal.getsignal(number) is fallback:  # not where it is ignored, as under nohup
            signal.signal(number, _leave)


def ends_with(code: int) -> None:
    """Note the exit code of a command that has done all that it had to do."""
    _exit_code[:] = [code]


def _end_process() -> None:
    """Without taking the interpreter apart, which lasts a tenth of a second and knows no handlers any more."""
    if _exit_code:
        for stream in (sys.stdout, sys.stderr):
            try:  # noqa: SIM105 (contextlib would be loaded first)
                stream.flush()
            except (OSError, ValueError):  # the reader is gone
                pass
        os._exit(_exit_code[0])


def _leave(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 (the protocol's signature)
    """No exception and no taking apart of the interpreter: neither is safe in the middle of everything."""
    for known in _SIGNALS:
        signal.signal(known, signal.SIG_IGN)
    threading.excepthook = lambda *_: None  # threads that wait for workers report that these are gone
    for clean in (_stop_workers, *reversed(_cleanups), _flush):
        try:  # noqa: SIM105 (as above)
            clean()
        except Exception:  # noqa: S110  (what comes next matters more)
            pass
    kept_there = "; ".join(said for place, said in _kept.items() if os.path.exists(place))  # noqa: PTH110 (loads less)
    line = f"evermap: {_SIGNALS[signal.Signals(number)]}: {kept_there or 'no result was written'}\n"
    if "rich.live" in sys.modules and sys.stderr.isatty():
        line = "\r\x1b[2K\x1b[?25h" + line  # a progress bar may stand there, and hides the cursor
    try:
        os.write(2, line.encode(errors="replace"))
    finally:
        os._exit(128 + number)


def _stop_workers() -> None:
    """Processes of `multiprocessing` would wait for work for ever, and its semaphores would be left."""
    if "multiprocessing.process" not in sys.modules:
        return
    from multiprocessing import active_children, util

    children = active_children()
    for child in children:
        child.kill()
    if children:
        util._exit_function()  # type: ignore[attr-defined]


def _flush() -> None:
    sys.stdout.flush()
