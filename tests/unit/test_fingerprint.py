"""Input that changed is another input, wherever the change lies (F32)."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from hybridvo.data.fingerprint import PART_BYTES, PARTS, input_hash, input_times

from hybridvo.cli import main
from hybridvo.data import fingerprint
from tests.walks import REFINE, command, write_walk


def files_of(folder: Path) -> SimpleNamespace:
    return SimpleNamespace(files=lambda: sorted(folder.iterdir()))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "made"
    made.mkdir()
    for k in range(3):
        (made / f"{k}.bin").write_bytes(bytes([k]) * 300_000)
    return made


def poke(path: Path, place: int) -> None:
    """Change a byte; size and time stay."""
    before = path.stat()
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize("place", [0, 5000, 150_000, 299_999])
def test_one_byte_anywhere_is_noticed(folder: Path, place: int) -> None:
    before = input_hash(files_of(folder))
    assert input_hash(files_of(folder)) == before
    poke(folder / "1.bin", place)
    assert input_hash(files_of(folder)) != before
    poke(folder / "1.bin", place)
    assert input_hash(files_of(folder)) == before
    assert input_times(files_of(folder)) is None


def test_a_copy_is_the_same_input(folder: Path, tmp_path: Path) -> None:
    before = input_hash(files_of(folder))
    shutil.copytree(folder, tmp_path / "copy", copy_function=shutil.copyfile)
    assert input_hash(files_of(tmp_path / "copy")) == before


def test_names_sizes_and_order_count(folder: Path) -> None:
    seen = {input_hash(files_of(folder))}
    (folder / "1.bin").rename(folder / "3.bin")
    seen.add(input_hash(files_of(folder)))
    with (folder / "3.bin").open("ab") as file:
        file.write(b"x")
    seen.add(input_hash(files_of(folder)))
    # the same bytes, cut elsewhere
    (folder / "0.bin").write_bytes(bytes(299_999))
    seen.add(input_hash(files_of(folder)))
    (folder / "0.bin").unlink()
    seen.add(input_hash(files_of(folder)))
    assert len(seen) == 5


def test_large_inputs_are_read_in_parts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fingerprint, "WHOLE_BYTES", 500_000)
    before, times = input_hash(files_of(folder)), input_times(files_of(folder))
    assert times is not None and input_times(files_of(folder)) == times
    for part in range(PARTS):
        start = part * (300_000 - PART_BYTES) // (PARTS - 1)
        poke(folder / "2.bin", start + part % 2 * (PART_BYTES - 1))
        assert input_hash(files_of(folder)) != before
        poke(folder / "2.bin", start + part % 2 * (PART_BYTES - 1))
    # between two parts the content is not seen, the time of the file is
    (folder / "2.bin").write_bytes(bytes([2]) * 5000 + b"x" + bytes([2]) * 294_999)
    os.utime(folder / "2.bin", ns=(1, 1))
    assert input_hash(files_of(folder)) == before and input_times(files_of(folder)) != times


def test_files_that_cannot_be_read_are_a_content_too(folder: Path) -> None:
    before = input_hash(files_of(folder))
    gone = SimpleNamespace(files=lambda: [*sorted(folder.iterdir()), folder / "gone.bin"])
    assert input_hash(gone) not in (before, "")


@pytest.mark.parametrize("large", [False, True])
def test_a_resume_sees_a_change_in_the_middle_of_a_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, large: bool
) -> None:
    if large:
        monkeypatch.setattr(fingerprint, "WHOLE_BYTES", 1000)
        monkeypatch.setattr(fingerprint, "PARTS", 2)
    walk = write_walk(tmp_path / "walk", 4, height=96, width=128)
    out = tmp_path / "out"
    assert main(command(walk, out, *REFINE)) == 0
    assert main(command(walk, out, *REFINE, "--resume")) == 0
    file = walk / "depth" / "000002.npy"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(1, 1))
    assert main(command(walk, out, *REFINE, "--resume")) == 2
    said = capsys.readouterr().err
    assert ("input_times" if large else "input_hash") in said and "--overwrite" in said
