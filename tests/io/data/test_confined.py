"""Recordings of foreign formats are read in a child process: alike, and within limits."""

from __future__ import annotations

import gc
import os
import platform
import signal
from pathlib import Path

import numpy as np
import pytest

from hybridvo import Camera, InputError, open_sequence
from hybridvo.core.errors import FormatError
from hybridvo.io.data.bags.reader import BagSequence
from hybridvo.io.data.confined import fork_server, limits, syscalls, wire
from hybridvo.io.data.confined import sequence as confined
from hybridvo.io.data.confined.sequence import ConfinedSequence, ReaderStopped
from hybridvo.io.data.sequence import Sequence
from tests import bags
from tests.evil_readers import BAD, FRAMES, EvilSequence

pytestmark = pytest.mark.skipif(
    not limits.is_available(), reason="no child process is limited on this system"
)
ALIKE = (
    *("kind", "name", "root", "warnings", "assumed", "height", "width", "topics"),
    *("depth_source", "flow_is_true", "depth_scale", "frames_per_second", "chosen"),
    *("rgb_files", "depth_files", "flow_files", "mask_files", "has_flow"),
)
LISTED = ("timestamps", "depth_timestamps", "poses")


def check_alike(one: Sequence, other: Sequence) -> None:
    for name in ALIKE:
        assert getattr(one, name, None) == getattr(other, name, None), name
    for name in LISTED:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert len(one) == len(other)
    assert one.files() == other.files()
    assert one.opened_with() == other.opened_with()
    for mine, theirs in zip(one, other, strict=True):
        assert mine.camera == theirs.camera
        assert (mine.timestamp, mine.index) == (theirs.timestamp, theirs.index)
        for name in ("rgb", "depth", "depth_variance", "mask"):
            np.testing.assert_array_equal(
                getattr(mine, name), getattr(theirs, name)
            )


@pytest.mark.parametrize("kind", bags.FORMATS)
def test_a_bag_is_read_alike_in_a_child(kind: str, tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, kind)
    given = {
        "camera": Camera(
            *bags.K, height=bags.SIZE[0], width=bags.SIZE[1], readout_ms=3
        ),
        "depth_scale": 0.5,
    }
    for options in ({}, given):
        in_child = open_sequence(path, **options)
        here = open_sequence(path, trust=True, **options)
        assert isinstance(in_child, ConfinedSequence)
        assert isinstance(here, BagSequence)
        check_alike(in_child, here)


def test_arrays_with_masks_and_poses_are_read_alike(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[2] = np.nan
    path = tmp_path / "walk.npz"
    np.savez_compressed(
        path,
        rgb=rng.integers(0, 255, (4, 24, 32, 3), np.uint8),
        depth=rng.integers(0, 65535, (4, 24, 32)).astype(np.uint16),
        K=np.array([[40, 0, 15.5], [0, 40, 11.5], [0, 0, 1]]),
        depth_scale=1000,
        poses=poses,
    )
    camera = tmp_path / "camera.yaml"
    camera.write_text(
        "fx: 40\nfy: 40\ncx: 15.5\ncy: 11.5\nwidth: 32\nheight: 24\n"
        "distortion: [0.1, 0, 0, 0]\n"
    )
    for options in ({}, {"camera": camera}, {"camera": "41,41,15,11"}):
        in_child = open_sequence(path, **options)
        assert isinstance(in_child, ConfinedSequence)
        check_alike(in_child, open_sequence(path, trust=True, **options))


def test_frames_come_alike_in_any_order(tmp_path: Path) -> None:
    """Also those that are read ahead and not asked for."""
    path = bags.plain_bag(tmp_path, "mcap", frames=12)
    sequence = open_sequence(path)
    here = open_sequence(path, trust=True)
    order = [0, 1, 2, 3, 9, 9, 2, 4, 6, 8, 10, 1, 0, 11, 10, 9, 8, -1]
    for index in order:
        frame = sequence.frame(index)
        assert frame.index == index
        np.testing.assert_array_equal(frame.rgb, here.frame(index).rgb)
    for wrong in (sequence, here):
        with pytest.raises(IndexError):
            wrong.frame(12)
        with pytest.raises(TypeError):
            wrong.frame(1.5)


def test_frames_do_not_share_memory_with_later_ones(tmp_path: Path) -> None:
    sequence = open_sequence(bags.plain_bag(tmp_path, "ros1"))
    first = sequence[0]
    for index in range(1, len(sequence)):
        sequence.frame(index)
    np.testing.assert_array_equal(first.rgb, bags.rgb(0))


def test_what_is_read_in_this_process(tmp_path: Path, walk: Path) -> None:
    """Folders of images, and arrays that are not packed."""
    rgb = np.zeros((2, 24, 32, 3), np.uint8)
    np.save(tmp_path / "rgb.npy", rgb)
    np.save(tmp_path / "depth.npy", np.ones((2, 24, 32), np.float32))
    arrays = open_sequence(tmp_path, camera="40,40,15.5,11.5")
    assert not isinstance(arrays, ConfinedSequence)
    assert not isinstance(open_sequence(walk), ConfinedSequence)


# -- what a hostile file can do ------------------------------------------------------------


def evil(folder: Path, deed: str, **chosen: str) -> ConfinedSequence:
    return ConfinedSequence(EvilSequence, folder, chosen={"deed": deed, **chosen})


CAUSES = {
    "take_memory": ("memory", "more than 448 MiB of memory"),
    "take_memory_and_hide_it": ("memory", "chunk is damaged.*448 MiB"),
    "compute": ("time", "more than 1 s of processor time"),
    "wait": ("stuck", "did nothing for 1 s"),
    "crash": ("died", "SIGSEGV"),
    "end": ("died", "ended"),
    "fail": ("unexpected", "KeyError: 'a bug'"),
}


@pytest.mark.parametrize("deed", CAUSES)
def test_a_hostile_frame_costs_one_frame(
    deed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CPU_S", 1)
    monkeypatch.setattr(confined, "STUCK_S", 1)
    reason, words = CAUSES[deed]
    sequence = evil(tmp_path, deed)
    # more often than a child is started anew
    for _ in range(confined.MAX_RESTARTS + 2 if deed == "crash" else 1):
        for index in range(FRAMES):
            if index != BAD:
                continue
            with pytest.raises(ReaderStopped, match=words) as caught:
                sequence.frame(index)
            text = str(caught.value)
            assert caught.value.reason == reason
            assert "--trust" in text
            assert f"frame {BAD}" in text or "chunk" in text
    if deed != "crash":
        values = [int(sequence.frame(i).rgb[0, 0, 0]) for i in (0, 1, 3, 4, 5)]
        assert values == [0, 1, 3, 4, 5]


@pytest.mark.parametrize("deed", ["take_memory", "compute", "crash", "fail"])
def test_a_hostile_file_is_refused_in_one_sentence(
    deed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CPU_S", 1)
    with pytest.raises(ReaderStopped, match=CAUSES[deed][1]) as caught:
        evil(tmp_path, deed, early="yes")
    assert str(tmp_path) in str(caught.value)
    assert "--trust" in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("deed", ["write", "open_many"])
def test_files_are_limited(deed: str, tmp_path: Path) -> None:
    sequence = evil(tmp_path, deed)
    with pytest.raises(OSError, match=r"too large|Too many"):
        sequence.frame(BAD)
    written = tmp_path / "large"
    assert not written.exists() or written.stat().st_size <= 80 * limits.MIB
    assert int(sequence.frame(3).rgb[0, 0, 0]) == 3


@pytest.mark.skipif(
    platform.machine() not in syscalls.MACHINES, reason="another processor"
)
@pytest.mark.parametrize("deed", ["connect", "run_program", "take_over"])
def test_a_child_reaches_nothing_but_files(deed: str, tmp_path: Path) -> None:
    sequence = evil(tmp_path, deed)
    with pytest.raises(PermissionError, match="not permitted"):
        sequence.frame(BAD)
    assert int(sequence.frame(3).rgb[0, 0, 0]) == 3


def test_a_child_has_threads(tmp_path: Path) -> None:
    assert int(evil(tmp_path, "thread").frame(BAD).rgb[0, 0, 0]) == BAD


def test_a_file_that_is_mapped_takes_no_memory(tmp_path: Path) -> None:
    assert int(evil(tmp_path, "map_file").frame(BAD).rgb[0, 0, 0]) == BAD


def test_a_frame_that_was_read_ahead_fails_when_it_is_asked_for(
    tmp_path: Path,
) -> None:
    sequence = evil(tmp_path, "crash")
    sequence._asked = [0, 0]
    sequence.frame(0)
    sequence._asked = [-1, 0]
    assert int(sequence.frame(1).rgb[0, 0, 0]) == 1
    assert sequence._ahead == BAD
    # it is dropped, and another child goes on
    assert int(sequence.frame(4).rgb[0, 0, 0]) == 4
    with pytest.raises(ReaderStopped, match=f"frame {BAD}"):
        sequence.frame(BAD)


def test_children_end_with_their_sequence(tmp_path: Path) -> None:
    sequence = evil(tmp_path, "wait")
    pid = sequence._child._forked.pid
    server = fork_server.server()
    del sequence
    gc.collect()
    # it has read the end of its connection: nothing had to end it
    assert os.waitstatus_to_exitcode(waited(server, pid)) == 0


def waited(server: fork_server.ForkServer, pid: int) -> int:
    while Path(f"/proc/{pid}/stat").exists():
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        if state == "Z":
            break
    return server.end(pid)


def test_another_server_is_started_where_one_was_killed(tmp_path: Path) -> None:
    first = evil(tmp_path, "wait")
    process = fork_server.server()._process
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    second = evil(tmp_path, "wait")
    assert fork_server.server()._process.pid != process.pid
    assert (
        int(first.frame(0).rgb[0, 0, 0]) == int(second.frame(0).rgb[0, 0, 0]) == 0
    )


def test_a_process_that_was_forked_has_a_child_of_its_own(tmp_path: Path) -> None:
    sequence = evil(tmp_path, "wait")
    first = sequence._child
    # as if this were another process
    first.process = -1
    assert int(sequence.frame(1).rgb[0, 0, 0]) == 1
    assert sequence._child is not first
    assert sequence._restarts == 0


FORMS = (
    None,
    "|u1",
    ["|O", [1]],
    ["|S5", [1]],
    ["|u1", [-1]],
    ["|u1", [True]],
    ["|u1", [2.0]],
    ["|u1", 3],
    ["<f8", [9]],
    ["|u1", [2**40, 2**40]],
)


@pytest.mark.parametrize("form", FORMS)
def test_an_array_that_cannot_be_is_refused(form: object) -> None:
    with pytest.raises(FormatError):
        wire.array_at(bytearray(64), 0, form)
    with pytest.raises(FormatError):
        wire.array_at(bytearray(64), -8, ["|u1", [4]])


@pytest.mark.parametrize(
    "answer",
    [
        {},
        {"images": {"rgb": 5}},
        {"images": {"rgb": [["|u1", [3, 3, 3]], 0]}},
        {"images": {"depth": [["|u1", [24, 32]], 2**40]}},
        {"images": []},
    ],
)
def test_a_child_that_sends_nonsense_gives_an_error(
    answer: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = evil(tmp_path, "wait")
    monkeypatch.setattr(sequence, "_answer", lambda where: (answer, {}))
    with pytest.raises(InputError):
        sequence.frame(0)
