from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from hybridvo.cli import main
from hybridvo.diagnosis import diagnose, diagnosis_text
from hybridvo.doctor import doctor, doctor_text
from hybridvo.errors import FormatError, InputError
from hybridvo.evaluation.report import to_json
from hybridvo.synthetic.render import SyntheticSequence, make_scene, write_sintel
from hybridvo.types import Frame


def test_everything_is_here() -> None:
    report = doctor()
    assert report["usable"] and report["missing"] == {}
    assert report["warm_up_s"] > 0 and report["numba_cache"]["files"] >= 0
    assert report["methods"]["refine"] == "" and "weights" in report["methods"]["vonet"]
    assert report["methods"]["hybrid"] == report["methods"]["pwvo"] == ""
    assert report["threads"]["numba"] >= 1 and "cpu" in report["devices"]
    text = doctor_text(report)
    assert "numpy" in text and text.endswith("ready\n")
    assert '"usable": true' in to_json(report)


def test_a_missing_package_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "evo" else find(name, *a)
    )
    report = doctor()
    assert not report["usable"]
    assert report["missing"] == {"evo": "pip install evo"}
    text = doctor_text(report)
    assert "MISSING    evo: pip install evo" in text and text.endswith("NOT ready: see above\n")


def test_a_part_that_fails_does_not_end_the_diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(report: object) -> None:
        raise RuntimeError("no driver")

    broken.__name__ = "_look_at_devices"
    monkeypatch.setattr("hybridvo.doctor._look_at_devices", broken)
    report = doctor()
    assert report["notes"] == ["devices: RuntimeError: no driver"]
    assert not report["usable"] and report["methods"]["refine"] == ""


# a sequence


@dataclass
class Recorded:
    """Frames in memory, with something done to them."""

    frames: list[Frame]
    poses: np.ndarray | None
    name: str = "recorded"
    broken: int = -1

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Frame:
        if index == self.broken:
            raise FormatError("frame.png: expected a picture")
        return self.frames[index]


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    """Seventeen clean frames of a static scene (17: intrinsics need fifteen pairs)."""
    sequence = SyntheticSequence(make_scene("static", 404, height=160, width=256, frames=17))
    return Recorded([sequence.frame(k) for k in range(17)], sequence.poses)


def state_of(report: dict[str, Any], name: str) -> dict[str, Any]:
    return next(finding for finding in report["findings"] if finding["name"] == name)


def changed(
    recorded: Recorded, change: Callable[[int, Frame], Frame], frames: int = 17
) -> dict[str, Any]:
    made = [change(k, f) for k, f in enumerate(recorded.frames[:frames])]
    return diagnose(replace(recorded, frames=made))


def test_a_clean_sequence_is_not_accused(recorded: Recorded) -> None:
    report = diagnose(recorded)
    assert report["ok"], diagnosis_text(report)
    assert report["pairs"] == report["used"] == 16
    scale = state_of(report, "depth units")
    assert scale["value"] == pytest.approx(1.0, abs=0.01)
    assert '"ok": true' in to_json(report)
    assert diagnosis_text(report).endswith("nothing differs\n")


def test_half_a_pixel_of_the_principal_point_is_found(recorded: Recorded) -> None:
    report = changed(
        recorded, lambda k, f: replace(f, camera=replace(f.camera, cx=f.camera.cx + 0.5))
    )
    found = state_of(report, "principal point")
    assert found["state"] == "differs"
    # its own standard error, four of them
    assert abs(found["value"][0] - 0.5) < 4 * found["standard_error"][0] < 0.5
    assert "Half a pixel" in found["message"]


def test_a_wrong_focal_length_is_found(recorded: Recorded) -> None:
    def stretched(k: int, f: Frame) -> Frame:
        return replace(f, camera=replace(f.camera, fx=1.03 * f.camera.fx, fy=1.03 * f.camera.fy))

    found = state_of(changed(recorded, stretched), "focal length")
    assert found["state"] == "differs"
    assert 1.5 < found["value"] < 6.0  # per cent; one Newton step, and 3 % is a long one


def test_depth_that_is_late_is_told_from_depth_that_is_shifted(recorded: Recorded) -> None:
    frames = recorded.frames
    late = changed(recorded, lambda k, f: replace(f, depth=frames[max(k - 1, 0)].depth), 10)
    assert state_of(late, "depth against colour, time")["state"] == "differs"
    # occlusion hides a part of one frame: 0.5 to 0.7 measured
    assert 0.3 < state_of(late, "depth against colour, time")["value"] < 1.3
    assert state_of(late, "principal point")["state"] == "not_observable"

    def right(k: int, f: Frame) -> Frame:
        return replace(f, rgb=np.roll(f.rgb, 3, axis=1))

    shifted = changed(recorded, right, 10)
    found = state_of(shifted, "depth against colour, place")
    assert found["state"] == "differs"
    assert -4.0 < found["value"][0] < -1.0 < found["value"][1] < 1.0
    assert state_of(shifted, "depth against colour, time")["state"] != "differs"


def test_units_and_exposure_are_named(recorded: Recorded) -> None:
    report = changed(
        recorded,
        lambda k, f: replace(
            f, depth=5 * f.depth, rgb=f.rgb if k % 4 else (0.6 * f.rgb).astype(np.uint8)
        ),
        10,
    )
    assert "divide it by 5" in state_of(report, "depth units")["message"]
    exposure = state_of(report, "exposure")
    assert exposure["state"] == "differs" and 0.3 < exposure["value"] < 0.6
    millimetres = replace(
        recorded, frames=[replace(f, depth=1000 * f.depth) for f in recorded.frames[:2]], poses=None
    )
    assert "divide it by 1000" in state_of(diagnose(millimetres), "depth units")["message"]


def test_a_scale_that_changes_on_the_way_is_named(recorded: Recorded) -> None:
    """Five times as deep from frame 6 on: no pair before or after can know, that one does."""
    blind = replace(recorded, poses=None)
    report = changed(blind, lambda k, f: replace(f, depth=(5 if k >= 6 else 1) * f.depth), 10)
    found = state_of(report, "depth from frame to frame")
    assert found["state"] == "differs" and "frame 5 to the next (times 5)" in found["message"]
    assert "1 of 9 pairs" in found["message"]
    whole = changed(blind, lambda k, f: replace(f, depth=5 * f.depth), 4)
    assert state_of(whole, "depth from frame to frame")["state"] == "agrees"
    assert state_of(whole, "depth units")["state"] == "not_observable"


def test_what_cannot_be_seen_is_left_open(recorded: Recorded) -> None:
    blind = replace(recorded, frames=[replace(f, rgb=None) for f in recorded.frames[:4]])
    report = diagnose(blind)
    assert report["ok"] and report["used"] == 0
    open_ones = [f["name"] for f in report["findings"] if f["state"] == "not_observable"]
    assert "principal point" in open_ones and "depth against colour, time" in open_ones
    still = replace(recorded, frames=[recorded.frames[0]] * 8, poses=None)
    report = diagnose(still)
    assert report["ok"], diagnosis_text(report)
    for name in ("depth against colour, time", "principal point", "focal length"):
        assert state_of(report, name)["state"] == "not_observable"


def test_a_broken_frame_does_not_end_the_diagnosis(recorded: Recorded) -> None:
    report = diagnose(replace(recorded, frames=recorded.frames[:5], broken=2))
    assert report["unreadable"] and report["pairs"] == 2
    with pytest.raises(InputError, match="at least two frames"):
        diagnose(replace(recorded, frames=recorded.frames[:1]))
    with pytest.raises(InputError, match="at least one pair"):
        diagnose(recorded, pairs=0)


def test_the_command_line_asks_the_sequence(tmp_path: Any, capsys: Any) -> None:
    write_sintel(make_scene("static", 1, height=48, width=80, frames=3), tmp_path, "made")
    folder = tmp_path / "training" / "clean" / "made"
    assert main(["doctor", "--sequence", str(folder), "--pairs", "1", "--json"]) == 0
    assert '"pairs": 1' in capsys.readouterr().out
    assert main(["doctor", "--sequence", str(tmp_path / "none")]) == 2
