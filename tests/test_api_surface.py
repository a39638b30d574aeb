"""The public names and their signatures, against ``data/api_surface.json``.

A change here is a change for users: write it down with

    python tests/test_api_surface.py --write

and say in CHANGELOG.md what it means for them.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
import json
import sys
from pathlib import Path
from typing import Any

import pytest

import hybridvo

SURFACE = Path(__file__).parent / "data" / "api_surface.json"
COMMAND = "python tests/test_api_surface.py --write"


def default_text(value: Any) -> str:
    if value is inspect.Parameter.empty:
        return ""
    if inspect.isfunction(value):
        return f" = {value.__qualname__}"
    return f" = {value!r}"


def signature_text(function: Any) -> str:
    """Names, kinds, annotations and defaults, without addresses and the same on all versions."""
    parts, keyword_only = [], False
    for p in inspect.signature(function).parameters.values():
        if p.kind is p.VAR_POSITIONAL:
            keyword_only = True
        if p.kind is p.KEYWORD_ONLY and not keyword_only:
            parts.append("*")
            keyword_only = True
        stars = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        annotation = p.annotation
        if not isinstance(annotation, str):
            annotation = "" if annotation is p.empty else inspect.formatannotation(annotation)
        text = f"{stars}{p.name}" + (f": {annotation}" if annotation else "")
        parts.append(text + default_text(p.default))
    returns = inspect.signature(function).return_annotation
    arrow = f" -> {returns}" if isinstance(returns, str) else ""
    return f"({', '.join(parts)}){arrow}"


def describe(value: Any) -> Any:
    """JSON form of one public name."""
    if isinstance(value, str):
        return "str"
    if inspect.isfunction(value):
        return signature_text(value)
    if not inspect.isclass(value):
        return type(value).__name__
    if issubclass(value, BaseException):
        return {"bases": [base.__name__ for base in value.__mro__[1:-1]]}
    if issubclass(value, enum.Enum):
        return {"members": {member.name: member.value for member in value}}
    members: dict[str, Any] = {"__init__": signature_text(value.__init__)}
    for name, member in sorted(vars(value).items()):
        if name.startswith("_"):
            continue
        if isinstance(member, property):
            members[name] = "property"
        elif isinstance(member, classmethod):
            members[name] = f"classmethod {signature_text(member.__func__)}"
        elif isinstance(member, staticmethod):
            members[name] = f"staticmethod {signature_text(member.__func__)}"
        elif inspect.isfunction(member):
            members[name] = signature_text(member)
    if dataclasses.is_dataclass(value):
        members["fields"] = [field.name for field in dataclasses.fields(value)]
    return members


def surface() -> dict[str, Any]:
    return {name: describe(getattr(hybridvo, name)) for name in sorted(hybridvo.__all__)}


@pytest.mark.parametrize("name", sorted(hybridvo.__all__))
def test_signature(name):
    known = json.loads(SURFACE.read_text(encoding="utf-8"))
    assert name in known, f"{name} is new: {COMMAND}"
    assert describe(getattr(hybridvo, name)) == known[name], f"changed on purpose? {COMMAND}"


def test_no_name_has_gone():
    assert set(json.loads(SURFACE.read_text(encoding="utf-8"))) == set(hybridvo.__all__)


def test_the_public_names():
    assert set(hybridvo.__all__) == {
        *("__version__", "Camera", "Frame", "FramePair", "PairBatch", "PixelwisePrediction"),
        *("RelativePose", "Status", "Step", "HybridVOError", "Odometry", "Trajectory"),
        *("estimate", "select", "refine", "open_sequence", "iter_pairs"),
    }
    assert len(hybridvo.__all__) == len(set(hybridvo.__all__))
    assert set(dir(hybridvo)) >= set(hybridvo.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'hybridvo' has no attribute 'Odometer'"):
        _ = hybridvo.Odometer


def test_every_public_name_has_a_docstring():
    for name in hybridvo.__all__:
        value = getattr(hybridvo, name)
        if not isinstance(value, str):
            assert inspect.getdoc(value), name
            for member, function in vars(value).items() if inspect.isclass(value) else ():
                if inspect.isfunction(function) and not member.startswith("_"):
                    assert inspect.getdoc(function), f"{name}.{member}"


def main(argv: list[str]) -> int:
    if argv != ["--write"]:
        sys.stderr.write(f"usage: {COMMAND}\n")
        return 2
    SURFACE.parent.mkdir(exist_ok=True)
    SURFACE.write_text(json.dumps(surface(), indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(f"{SURFACE}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
