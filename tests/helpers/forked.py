"""`holosplat` as blocks of the documentation call it, in a process of its own that begins where one stands which has
loaded PyTorch and the rest: importing takes longer than most of these commands.

    python forked.py SOCKET

serves them; a script `holosplat` in a folder of PATH hands a command over (`served`). Streams, folder, environment and
exit code are the caller's, and signals reach the command. Torch takes one thread, as in other tests, light is plain and
runs are not judged (`helpers.unjudged`), fits are short (`helpers.short`), and figures of reports are blank
(`helpers.pictures`).
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

CALL = """#!{python} -IS
import json, os, signal, socket, sys
there = socket.socket(socket.AF_UNIX)
there.connect({path!r})
said = json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode()
socket.send_fds(there, [len(said).to_bytes(8, "big")], [0, 1, 2])
there.sendall(said)
answer = there.makefile()
process = int(answer.readline())
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: os.kill(process, number))
sys.exit(int(answer.readline() or 1))
"""


@contextmanager
def served() -> Iterator[Path]:
    """A folder for PATH with such a `holosplat`, as long as the context lasts."""
    with tempfile.TemporaryDirectory() as folder:  # a short path, as sockets need
        script, path = Path(folder) / "holosplat", os.path.join(folder, "socket")
        script.write_text(CALL.format(python=sys.executable, path=path), encoding="utf-8")
        script.chmod(0o755)
        tests = {"PYTHONPATH": str(Path(__file__).parents[1])}
        command = [sys.executable, "-P", __file__, path]
        with subprocess.Popen(command, env=os.environ | tests, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            assert server.stdout.readline() == "ready\n"
            yield Path(folder)
            server.terminate()


def serve(path: str) -> None:
    """Fork for each command that comes, until a signal ends it."""
    import torch

    import holosplat.methods
    import holosplat.report
    import holosplat.workflows.reconstruct  # noqa: F401 - loaded for the commands
    from helpers.pictures import undrawn
    from helpers.short import in_short_fits
    from helpers.unjudged import in_plain_light, unjudged
    from holosplat.cli import main

    torch.set_num_threads(1)
    os.fsync = os.fstat  # what commands write need not survive a power cut
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # children leave no trace
    with socket.socket(socket.AF_UNIX) as door, in_plain_light(), unjudged(), in_short_fits(), undrawn(first=False):
        door.bind(path)
        door.listen()
        print("ready", flush=True)
        while True:
            caller, _ = door.accept()
            if os.fork() == 0:
                door.close()
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                _command(caller, main)
            caller.close()


def _command(caller: socket.socket, main: Callable[[], None]) -> None:
    """Become the command of a caller, and tell it the exit code."""
    size, streams, *_ = socket.recv_fds(caller, 8, 3)
    words, folder, environment = json.loads(caller.recv(int.from_bytes(size, "big"), socket.MSG_WAITALL))
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    caller.sendall(f"{os.getpid()}\n".encode())
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv, code = ["holosplat", *words], 1
    try:
        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    caller.sendall(f"{code}\n".encode())
    os._exit(code)


if __name__ == "__main__":
    serve(sys.argv[1])
