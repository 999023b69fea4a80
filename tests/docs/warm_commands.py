"""The commands `evermap` and `python -c` for the documents' checks: copies of a process that has loaded the kernels.

Of the seconds of most commands of the pages, the greater part goes into imports and into loading machine code, a
hundred times the same. So one process does that, and each command is a fork of it, with the folder, the environment
and the streams of its caller, and ends as the installed command does. It is `evermap.__main__.run` in both; that this
starts in a fresh process is what the README's first commands show, and the notebooks, which are run without this.
"""

from __future__ import annotations

import atexit
import fcntl
import json
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

SHIM = """#!{python} -IS
import json, os, socket, sys
if sys.argv[0].endswith("python") and (len(sys.argv) != 3 or sys.argv[1] != "-c"):
    os.execv({python!r}, [{python!r}, *sys.argv[1:]])
with socket.socket(socket.AF_UNIX) as to:
    to.connect({address!r})
    socket.send_fds(to, [b"-"], [0, 1, 2])
    to.sendall(json.dumps([sys.argv, os.getcwd(), dict(os.environ)]).encode())
    to.shutdown(socket.SHUT_WR)
    sys.exit(int(to.recv(8) or b"70"))
"""
"""What takes the place of the installed commands; an answer that does not come is a failure of the machinery: 70."""


@contextmanager
def warm_commands(environment: dict[str, str], shared: Path) -> Iterator[dict[str, str]]:
    """Yield the environment in which `evermap` is a fork of a process that is ready.

    Processes of tests that give the same folder share one: the first starts it, and ends it when all left the block.
    """
    where, process = shared / "warm.txt", None
    with (shared / "warm-start.lock").open("a") as start, (shared / "warm-users.lock").open("a") as users:
        fcntl.flock(start, fcntl.LOCK_EX)
        if not where.exists():
            folder = Path(tempfile.mkdtemp(prefix="evermap-warm-"))
            process = _begin(folder, environment)
            where.write_text(str(folder), encoding="utf-8")
        fcntl.flock(users, fcntl.LOCK_SH)
        fcntl.flock(start, fcntl.LOCK_UN)
        try:
            yield {**environment, "PATH": os.pathsep.join([where.read_text(encoding="utf-8"), environment["PATH"]])}
        finally:
            fcntl.flock(users, fcntl.LOCK_UN)
            if process is not None:
                fcntl.flock(start, fcntl.LOCK_EX)  # nobody joins while it waits for the others
                fcntl.flock(users, fcntl.LOCK_EX)
                where.unlink()
                with process:
                    process.terminate()
                shutil.rmtree(folder)


def _begin(folder: Path, environment: dict[str, str]) -> subprocess.Popen[str]:
    """Start the process that answers, and put the commands that ask it into the folder."""
    address = folder / "socket"
    for name in ("evermap", "python"):
        shim = folder / name
        shim.write_text(SHIM.format(python=sys.executable, address=str(address)), encoding="utf-8")
        shim.chmod(shim.stat().st_mode | stat.S_IXUSR)
    process = subprocess.Popen(
        [sys.executable, __file__, str(address)], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def prepare() -> None:
    """Run what most pages do once, for its imports and kernels, and forget how it ended."""
    from evermap import interrupts
    from evermap.cli.main import run

    for line in ("init recording plane", "map enter a plane", "init flight space", "slam space --out b"):
        sys.argv = ["evermap", *line.split()]
        with suppress(SystemExit):
            run()
        assert interrupts._exit_code == [0], line
        interrupts._exit_code.clear()  # else a fork that fails would end with it
        interrupts._kept.clear()
    assert threading.active_count() == 1, "a fork has one thread, and waits for the others for ever"


def answer(caller: socket.socket) -> None:
    """Run the caller's command in a fork of this process, and send its exit code."""
    _, streams, _, _ = socket.recv_fds(caller, 1, 3)
    argv, folder, environment = json.loads(b"".join(iter(lambda: caller.recv(1 << 16), b"")))
    child = os.fork()
    if child:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        caller.sendall(str(status if status >= 0 else 128 - status).encode())
        os._exit(0)
    caller.close()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    if argv[0].endswith("python"):
        run_text(argv[2])
    else:
        sys.argv = argv
        from evermap.__main__ import run

        run()


def run_text(text: str) -> None:
    """Run a program as `python -c` does: as the module `__main__`, with the folder's modules before all others.

    It ends without taking down all that was loaded, which takes 2 s.
    """
    code = 1

    def end() -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)

    atexit.register(end)  # what the program registers is called before
    sys.argv, sys.path[0] = ["-c"], ""
    main = sys.modules["__main__"] = ModuleType("__main__")
    try:
        exec(compile(text, "<string>", "exec"), vars(main))
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        raise


def serve(address: str) -> None:
    """Answer each caller in a process of its own, until terminated."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(address)
        server.listen(16)
        os.write(1, b"ready\n")
        while True:
            caller, _ = server.accept()
            if os.fork() == 0:
                server.close()
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                answer(caller)
                return
            caller.close()


if __name__ == "__main__":
    address, out = sys.argv[1], os.dup(1)
    os.dup2(2, 1)  # what is printed while it prepares is not for the caller
    prepare()
    os.dup2(out, 1)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel forgets callers that were answered
    serve(address)
