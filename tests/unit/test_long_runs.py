"""Long runs in the short (F35): tools/stress.py measures 20 000 frames from outside."""

from __future__ import annotations

import gc
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from hybridvo import recording
from hybridvo.cli import main
from hybridvo.run_folder import RunFolder

TOOLS = Path(__file__).parents[2] / "tools"
FRAMES, WARM = 160, 60


def open_files() -> int:
    return len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0


@pytest.mark.parametrize("recorded", [False, True])
def test_a_run_keeps_nothing_of_its_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorded: bool
) -> None:
    if recorded:
        pytest.importorskip("rerun", reason="Rerun is not installed (extra viz)")
        # what is not written yet is held: 2 kB a frame, here of 20 frames
        monkeypatch.setattr(recording, "CHUNK_ROWS", 20)
    monkeypatch.syspath_prepend(TOOLS)
    from stress_parts import REFINE, command, write_walk

    walk = write_walk(tmp_path / "walk", FRAMES, distinct=8, pictures=recorded)
    memory, files = [], []
    append = RunFolder.append

    def watch(self: RunFolder, row: dict) -> None:
        append(self, row)
        if self.frames_done in (WARM, FRAMES - 1):
            gc.collect()
            memory.append(tracemalloc.get_traced_memory()[0])
            files.append(open_files())

    monkeypatch.setattr(RunFolder, "append", watch)
    out = tmp_path / "out"
    tracemalloc.start()
    try:
        options = ["--rrd"] if recorded else []
        assert main(command(walk, out, *REFINE, *options)) == 0
    finally:
        tracemalloc.stop()
    # one frame is 25 kB: keeping every tenth would be 250 kB. A recording keeps one position a
    # frame (12 bytes) and 20 frames; caches of the interpreter and numpy move by some 10 kB
    assert memory[1] - memory[0] < 100_000
    assert files[1] == files[0]
    with np.load(out / "steps.npz") as steps:
        assert len(steps["covariance"]) == FRAMES
        assert all(np.isfinite(steps[name]).all() for name in steps)
        assert (np.linalg.eigvalsh(steps["covariance"]) > 0).all()


def test_rows_of_a_run_stay_on_the_disk(tmp_path: Path) -> None:
    row = {"index": 0, "T_world_cam": np.eye(4).ravel(), "covariance": np.eye(6).ravel()}
    with RunFolder(tmp_path, {}, {}) as folder:
        for _ in range(50):
            folder.append(row)
        tracemalloc.start()
        try:
            for _ in range(2000):
                folder.append(row)
            kept = tracemalloc.get_traced_memory()[0]
            assert sum(1 for _ in folder.rows()) == 2050
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    # a row takes 600 bytes as text and 3 kB as numbers: 2000 of them would be 1.2 or 6 MB
    assert kept < 20_000 and peak < 200_000
