"""What a run writes of the things that move by themselves."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo.run.cli import main
from hybridvo.run.commands.object_rows import COLUMNS, OBJECTS
from hybridvo_lab.synthetic.render import write_sintel
from hybridvo_lab.synthetic.scenes import make_scene

FRAMES = 4
SIZE = (96, 160)


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered scene with several things that move, as files."""
    root = tmp_path_factory.mktemp("moving")
    scene = make_scene("light", 1, height=SIZE[0], width=SIZE[1], frames=FRAMES)
    write_sintel(scene, root, "moving")
    return root / "training" / "clean" / "moving"


def run(sequence: Path, out: Path, *options: str) -> None:
    words = ["run", str(sequence), "--out", str(out), "--method", "classical", "-q"]
    assert main([*words, "--flow", "dis", *options]) == 0


@pytest.mark.slow
def test_objects_are_a_table_and_pictures(moving: Path, tmp_path: Path) -> None:
    given = ["--set", "track.objects=auto", "--export", "transforms"]
    run(moving, tmp_path, *given)
    with (tmp_path / OBJECTS).open() as file:
        rows = list(csv.DictReader(file))
    assert rows and tuple(rows[0]) == COLUMNS
    for row in rows:
        assert 0 < int(row["index"]) < FRAMES
        assert row["state"] in ("seen", "hidden")
        assert 0 <= float(row["confidence"]) <= 1
        assert float(row["sigma_trans"]) > 0
        if row["state"] == "hidden":
            continue
        path = tmp_path / "export" / "objects" / f"{int(row['index']):06d}.png"
        numbers = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert (numbers.shape, numbers.dtype) == (SIZE, np.uint16)
        share = np.mean(numbers == int(row["id"]))
        assert share == pytest.approx(float(row["fraction"]), abs=0.01)
    # they are no column of the steps, and no part of a finished run's state
    assert "objects" not in (tmp_path / "steps.csv").read_text().split("\n")[0]
    run(moving, tmp_path, *given[:2], "--overwrite")
    assert not list((tmp_path / "export").glob("objects/*.png"))


def test_without_the_option_there_is_no_table(moving: Path, tmp_path: Path) -> None:
    run(moving, tmp_path)
    assert not (tmp_path / OBJECTS).exists()
