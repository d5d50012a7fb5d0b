# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A Python that has imported PyTorch and radarsdf already, as a command: imports take seconds, a fork of them takes none.

``warm_python()`` gives the first words of the command; ``-c CODE``, ``-m MODULE`` or a script and their arguments follow. There are
three kinds of processes:

- the server, one for all tests, which :func:`warm_python` starts. It has imported everything, has no threads, and forks itself for
  each command (:func:`_serve`);
- the fork, which does what the command asks for (:func:`_run`);
- the front, which the test sees as the command: a small process that hands on its streams, folder, variables and signals to the
  fork, and ends with the status of the fork (:func:`_ask`).

Front and server have a connection for each command. The front sends the length of what it asks for, with its three streams; the
words, folder and variables as JSON; then a byte for each signal. The server sends the status, four bytes. A connection that ends
before means that the front was killed: so is the fork.

Not for tests of what is imported, of variables that are read while it is, or of streams that are closed from the start.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_IMPORTED = (
    "radarsdf.cli",
    "radarsdf.evaluation",
    "radarsdf.fitting.fit",
    "radarsdf.map.mesh",
    "radarsdf.simulate",
)


@functools.cache
def warm_python() -> list[str]:
    """The command; on other systems than Linux that of any Python."""
    if sys.platform != "linux":
        return [sys.executable]
    folder = tempfile.TemporaryDirectory(prefix="warm-python-")
    path = str(Path(folder.name) / "socket")
    root = Path(__file__).resolve().parents[1]
    server = subprocess.Popen(
        [sys.executable, "-m", "tests.warm_python", path],
        cwd=root,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )

    def end() -> None:
        server.stdin.close()
        server.stdout.close()
        server.wait()
        folder.cleanup()

    atexit.register(end)
    assert server.stdout.readline() == b"ready\n"
    # Without site-packages, which take time to look through.
    return [sys.executable, "-I", "-S", __file__, path]


def _ask(path: str, words: list[str]) -> int:
    """What the front does. Gives the status of the fork, that of :func:`os.waitpid`."""
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(path)
        asked = json.dumps([words, str(Path.cwd()), dict(os.environ)]).encode()
        socket.send_fds(server, [len(asked).to_bytes(8, "big")], [0, 1, 2])
        for number in _SIGNALS:
            signal.signal(number, lambda number, _: server.sendall(bytes([number])))
        server.sendall(asked)
        # Only the fork holds them: who reads its output sees when it ends.
        for stream in range(3):
            os.close(stream)
        return int.from_bytes(server.recv(4), "big")


def _serve(path: str) -> None:
    """What the server does, until the tests have ended."""
    for name in _IMPORTED:
        __import__(name)
    with socket.socket(socket.AF_UNIX) as listener, selectors.DefaultSelector() as waiting:
        listener.bind(path)
        listener.listen()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        waiting.register(listener, selectors.EVENT_READ)
        waiting.register(0, selectors.EVENT_READ)  # closed where the tests have ended
        # Forks by their pidfds, with the connections of their fronts.
        children: dict[int, tuple[int, socket.socket]] = {}
        while True:
            for key, _ in waiting.select():
                if key.fileobj == 0:
                    for child, _ in children.values():
                        os.kill(child, signal.SIGKILL)
                    return
                if key.fileobj is listener:
                    front, _ = listener.accept()
                    if (child := _forked(front)) is None:
                        continue
                    ended = os.pidfd_open(child)
                    children[ended] = child, front
                    for either in (front, ended):  # the front has a signal or is gone; the fork has ended
                        waiting.register(either, selectors.EVENT_READ, ended)
                elif key.data not in children:
                    continue  # it ended while its front was killed
                elif isinstance(key.fileobj, socket.socket):
                    with contextlib.suppress(ConnectionError):
                        numbers = key.fileobj.recv(1)
                    os.kill(children[key.data][0], numbers[0] if numbers else signal.SIGKILL)
                    if not numbers:
                        waiting.unregister(key.fileobj)
                else:
                    child, front = children.pop(key.data)
                    status = os.waitpid(child, 0)[1]
                    with contextlib.suppress(OSError):
                        front.sendall(status.to_bytes(4, "big"))
                    with contextlib.suppress(KeyError):
                        waiting.unregister(front)
                    waiting.unregister(key.data)
                    os.close(key.data)
                    front.close()


def _forked(front: socket.socket) -> int | None:
    """The number of the fork that does what a front asks for; None if the front was gone before it asked."""
    length, streams, _, _ = socket.recv_fds(front, 8, 3)
    asked = b""
    while len(asked) < int.from_bytes(length, "big"):
        if not (more := front.recv(1 << 16)):
            return None
        asked += more
    if (child := os.fork()) == 0:
        front.close()
        for stream, given in enumerate(streams):
            os.dup2(given, stream)
        _run(*json.loads(asked))
    for stream in streams:
        os.close(stream)
    return child


def _run(words: list[str], folder: str, environment: dict[str, str]) -> None:
    """What the fork does: all that a Python does between its start and its end."""
    os.closerange(3, 1024)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", encoding="utf-8", closefd=False, buffering=1)  # noqa: SIM115
    status = 0
    try:
        _run_words(words)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
    except BaseException as error:  # noqa: BLE001
        traceback.print_exc()
        status = -signal.SIGINT if type(error) is KeyboardInterrupt else 1
    with contextlib.suppress(OSError):
        if sys.stdout is not None:
            sys.stdout.flush()
    if status < 0:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    os._exit(status)


def _run_words(words: list[str]) -> None:
    import runpy  # noqa: PLC0415 - not in front of the fork
    import types  # noqa: PLC0415

    if words[0] == "-m":
        sys.argv, sys.path[0] = words[1:], str(Path.cwd())
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    elif words[0] == "-c":
        sys.argv, sys.path[0] = ["-c", *words[2:]], ""
        sys.modules["__main__"] = main = types.ModuleType("__main__")
        exec(compile(words[1], "<string>", "exec"), main.__dict__)  # noqa: S102
    else:
        sys.argv, sys.path[0] = words, str(Path(words[0]).parent)
        runpy.run_path(words[0], run_name="__main__")


if __name__ == "__main__":
    if len(sys.argv) == 2:
        _serve(sys.argv[1])
    else:
        status = _ask(sys.argv[1], sys.argv[2:])
        if os.WIFSIGNALED(status):
            if os.WTERMSIG(status) != signal.SIGKILL:
                signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
            os.kill(os.getpid(), os.WTERMSIG(status))
        os._exit(os.WEXITSTATUS(status))
