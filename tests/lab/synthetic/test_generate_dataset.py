from __future__ import annotations

import pytest

from tests.scripts import load_script

SMALL = ["--height", "32", "--width", "64", "--frames", "3"]


@pytest.fixture(scope="module")
def tool():
    return load_script("tools/generate_dataset.py")


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
