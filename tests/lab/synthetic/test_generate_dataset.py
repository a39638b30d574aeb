from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hybridvo.io.data.image_io import read_flow
from hybridvo.lab.synthetic.scenes import make_scene
from tests.scripts import load_script

SMALL = ["--height", "32", "--width", "64", "--frames", "3"]


@pytest.fixture(scope="module")
def tool():
    return load_script("tools/generate_dataset.py")


def test_writes_every_scene_and_seed(tool, tmp_path, capsys):
    arguments = [
        "--scene",
        "light",
        "--scene",
        "static",
        "--seed",
        "0",
        "--seed",
        "5",
    ]
    assert tool.main(["--out", str(tmp_path), *arguments, *SMALL]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    names = [
        f"{kind}_{seed}"
        for kind in ("light", "static")
        for seed in ("0000", "0005")
    ]
    assert [Path(row["sequence"]).name for row in rows] == names
    assert rows[0]["moving_share_min"] > 0.1
    assert rows[3]["moving_share_max"] == 0
    flow = read_flow(tmp_path / "training/flow/light_0005/frame_0002.flo")[0]
    scene = make_scene("light", 5, height=32, width=64, frames=3)
    np.testing.assert_array_equal(flow, scene.flow(1)[0])


def test_never_overwrites_unasked_and_leaves_no_old_frame(tool, tmp_path, capsys):
    base = ["--out", str(tmp_path), "--scene", "static", *SMALL]
    assert tool.main(base) == 0
    assert tool.main(base) == 2
    error = capsys.readouterr().err
    assert "--overwrite" in error
    assert "Traceback" not in error
    assert tool.main([*base, "--frames", "2", "--overwrite"]) == 0
    clean = tmp_path / "training/clean/static_0000"
    assert sorted(p.name for p in clean.iterdir()) == [
        "frame_0001.png",
        "frame_0002.png",
    ]


def test_bad_input_ends_with_two(tool, tmp_path, capsys):
    assert tool.main(["--out", str(tmp_path), "--scene", "nonsense"]) == 2
    assert "heavy_two" in capsys.readouterr().err
    assert not (tmp_path / "training").exists()


def test_unwritable_output_ends_with_five(tool, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder is wanted")
    assert tool.main(["--out", str(blocked), *SMALL]) == 5
