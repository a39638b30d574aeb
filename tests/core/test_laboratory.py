"""What hybridvo does where hybridvo-lab is not installed, and what it finds where it is."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

import hybridvo as hvo
from hybridvo.core import laboratory
from hybridvo.run.cli import main
from hybridvo.run.commands.text import text_of
from tests.project.source_tree import ROOT


@pytest.fixture
def not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(laboratory, "_points", lambda group: {})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The example frames as a folder, with a true path."""
    import cv2
    import numpy as np

    root = tmp_path / "room"
    for name in ("rgb", "depth"):
        (root / name).mkdir(parents=True)
    frames = hvo.example_frames()
    for k, frame in enumerate(frames):
        cv2.imwrite(str(root / f"rgb/{k}.png"), frame.rgb[..., ::-1])
        depth = np.round(1000 * np.clip(frame.depth, 0, 60)).astype(np.uint16)
        cv2.imwrite(str(root / f"depth/{k}.png"), depth)
    camera = frames[0].camera
    (root / "camera.yaml").write_text(
        f"fx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\n"
        f"width: {camera.width}\nheight: {camera.height}\n"
        "depth_scale: 1000\nfps: 24\n"
    )
    poses = [f"{k / 24} {0.01 * k} 0 0 0 0 0 1" for k in range(len(frames))]
    (root / "poses.txt").write_text("\n".join(poses) + "\n")
    return root


def test_every_entry_point_leads_to_something() -> None:
    text = (ROOT / "hybridvo_lab/pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    assert project["version"] == hvo.__version__
    stated = project["entry-points"]
    for group, points in stated.items():
        assert set(laboratory.names_of(group)) == set(points)
        for name in points:
            assert laboratory.find(group, name) is not None


@pytest.mark.usefixtures("not_installed")
@pytest.mark.parametrize(
    "command", [["compare", "."], ["demo"], ["generate", "--out=x"]]
)
def test_a_command_names_what_it_needs(command, capsys) -> None:
    assert main(command) == 2
    said = capsys.readouterr().err
    assert f"'hybridvo {command[0]}' needs hybridvo-lab: pip install" in said


def test_a_run_is_scored_with_it(folder, tmp_path) -> None:
    assert main(["run", str(folder), f"--out={tmp_path / 'out'}", "-q"]) == 0
    assert (tmp_path / "out/trajectory.png").exists()
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["rot_err_deg_mean"] is not None


@pytest.mark.usefixtures("not_installed")
def test_a_run_without_it_has_a_path_and_says_what_is_missing(
    folder, tmp_path, capsys
) -> None:
    assert main(["run", str(folder), f"--out={tmp_path / 'out'}"]) == 0
    assert "no errors and no picture" in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"trajectory.tum", "steps.csv", "run.json"} <= written
    assert not {"metrics.json", "trajectory.png"} & written


@pytest.mark.usefixtures("not_installed")
def test_a_method_that_it_brings_is_refused_with_the_remedy() -> None:
    with pytest.raises(hvo.InputError, match="more with hybridvo-lab: pip install"):
        hvo.Odometry(method="pnp-ransac")
    with pytest.raises(
        hvo.InputError, match=r"hybridvo\.evaluate needs hybridvo-lab"
    ):
        hvo.evaluate(None, None)


@pytest.mark.parametrize("lack", ["", "no hybridvo_lab"])
def test_doctor_promises_the_demo_only_with_it(lack) -> None:
    names = ("packages", "methods", "extras")
    content = dict.fromkeys(("platform", "kernels"), "") | {"cuda": []}
    content |= {name: {} for name in names}
    content["methods"] = {"hybrid": ""}
    content["extras"] = {"lab": lack}
    *_, last = text_of("doctor", content).splitlines()
    assert ("hybridvo demo" in last) == (not lack)
