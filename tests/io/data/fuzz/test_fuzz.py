"""5 000 changed recordings: none hangs, eats memory, or ends as a bug.

What a recording may cost beyond that is limited by the child that reads it: see
``hybridvo/io/data/confined/``. ``mutated(KIND, SEED, FOLDER)`` writes one again.
"""

from __future__ import annotations

import contextlib
import resource
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from hybridvo import open_sequence
from hybridvo.core.errors import HybridVOError
from hybridvo.io.data.confined.limits import CONFINED, CPU_S, MIB, is_available
from hybridvo.io.data.confined.sequence import ReaderStopped
from tests.io.data.fuzz.mutate import MUTATORS, mutated

QUICK = 7
"""Changed recordings of each kind that are always read."""
ALL = 334
"""Of each kind in the slow test: 5 010."""
HANG_CPU_S = 20
"""Processor time after which reading hangs, seconds; of a clock the load would count."""
MOST_MEMORY = 500_000_000
"""Bytes that a recording of a few kilobytes may cost."""

pytestmark = pytest.mark.skipif(
    not is_available(), reason="no child process is limited on this system"
)


class Hang(BaseException):
    """No ``except Exception`` of a reader takes it."""


@contextlib.contextmanager
def no_hang() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, HANG_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def outcome(path: Path) -> str:
    """Read a recording as a command would: opened, refused, or stopped at a limit.

    Anything but an error that the command line prints in one sentence is raised.
    """
    found = "read"
    try:
        sequence = open_sequence(path)
    except ReaderStopped as stop:
        return stop.reason
    except (HybridVOError, OSError):
        return "refused"
    for index in sorted({0, 1, len(sequence) - 1} & set(range(len(sequence)))):
        try:
            sequence.frame(index)
        except ReaderStopped as stop:
            return stop.reason
        except (HybridVOError, OSError):
            found = "a frame refused"
    return found


def peak_bytes() -> int:
    """The memory that this process has ever had; that of a child is limited."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def check(kind: str, seeds: range, folder: Path) -> Counter[str]:
    """Read the changed recordings of some seeds; return how often each outcome came."""
    grown = 0
    outcomes: Counter[str] = Counter()
    bugs = []
    for seed in seeds:
        root = folder / str(seed)
        root.mkdir()
        path = mutated(kind, seed, root)
        before = peak_bytes()
        with no_hang():
            found = outcome(path)
        grown = max(grown, peak_bytes() - before)
        outcomes[found] += 1
        # a child that died or hung, or an error that no reader expects
        if found in ("died", "stuck", "unexpected"):
            bugs.append((seed, found))
        shutil.rmtree(root)
    assert not bugs, f"{kind}: {bugs}; {outcomes}"
    assert grown < MOST_MEMORY, f"{kind}: {grown} bytes"
    return outcomes


@pytest.mark.slow
@pytest.mark.parametrize("kind", MUTATORS)
def test_some_changed_recordings_are_read_or_refused(
    kind: str, tmp_path: Path
) -> None:
    assert check(kind, range(QUICK), tmp_path).total() == QUICK


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", MUTATORS)
def test_changed_recordings_are_read_or_refused(kind: str, tmp_path: Path) -> None:
    if kind == "record3d":
        # without the extra, all of them are refused
        pytest.importorskip("liblzfse")
    outcomes = check(kind, range(ALL), tmp_path)
    # else the changes are too many, or too few, to find anything
    assert outcomes["read"]
    # a bag is read to its end without its metadata, whatever is in them
    if kind != "metadata":
        assert outcomes["refused"] + outcomes["a frame refused"]


def test_the_limits_of_a_small_file_are_those_of_this_test() -> None:
    for kind in ("bag", "record3d", "arrays"):
        assert CONFINED[kind].memory < MOST_MEMORY
        assert CONFINED[kind].memory >= 400 * MIB
    assert CPU_S < HANG_CPU_S
