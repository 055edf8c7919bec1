"""How commands end where the machine or its user ends them: saved, and with one sentence."""

from __future__ import annotations

import signal
import sys

import pytest

from holosplat.cli import entry
from holosplat.cli.progress import ASKING, end_as_on_interrupt
from holosplat.fit.run import interrupts_held


@pytest.fixture
def handlers():
    """All handlers as the system has them, and afterwards as they were."""
    before = {number: signal.getsignal(number) for number in (*ASKING, signal.SIGINT)}
    for number in ASKING:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ASKING)
@pytest.mark.parametrize("background", [False, True])
@pytest.mark.usefixtures("handlers")
def test_a_warning_is_an_interrupt(number, background):
    """Also in a job of a shell's background, which takes no Ctrl-C."""
    if background:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_as_on_interrupt()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)


@pytest.mark.usefixtures("handlers")
def test_a_warning_waits_for_the_end_of_a_step():
    end_as_on_interrupt()
    with interrupts_held() as release:
        signal.raise_signal(signal.SIGTERM)  # nothing yet
        with pytest.raises(KeyboardInterrupt):
            release()


@pytest.mark.usefixtures("handlers")
def test_what_is_ignored_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    end_as_on_interrupt()
    signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            PermissionError(13, "Permission denied", "a.nxs"),
            "cannot be read or written ([Errno 13] Permission denied: 'a",
        ),
        (OSError(36, "File name too long"), "File name too long); check its path, its permissions and the disk."),
        (MemoryError(), "the memory of this machine is not enough; take larger pixels"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 8 bytes"), "is not enough ([enforce"),
        (OSError(12, "Cannot allocate memory"), "the memory of this machine is not enough ([Errno 12]"),
        (RecursionError(), "the input is nested too deeply; make it flat."),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates not allowed"), "a name or text is none in UTF-8"),
    ],
)
@pytest.mark.usefixtures("handlers")
def test_what_the_machine_cannot_do_is_one_sentence(error, said, monkeypatch, capsys):
    def fail() -> None:
        raise error

    monkeypatch.setattr(entry, "command", lambda name: fail)
    monkeypatch.setattr(sys, "argv", ["holosplat", "backends"])
    with pytest.raises(SystemExit) as end:
        entry.main()
    assert end.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("holosplat: ")
    assert said in lines[0]


@pytest.mark.usefixtures("handlers")
def test_a_fault_of_the_program_is_not_called_one_of_memory(monkeypatch):
    def fail() -> None:
        raise RuntimeError("shapes differ")

    monkeypatch.setattr(entry, "command", lambda name: fail)
    monkeypatch.setattr(sys, "argv", ["holosplat", "backends"])
    with pytest.raises(RuntimeError, match="shapes differ"):
        entry.main()
