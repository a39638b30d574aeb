"""What a report shows, read from the folder of a comparison and made ready for tables and plots.

Nothing here trusts the folder: a file that is missing, or a value that is not as described in
:mod:`hybridvo.evaluation.report_page`, is an error that names it.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.errors import FormatError, HybridVOError, InputError
from hybridvo.evaluation.metrics import AbsoluteError, ate
from hybridvo.evaluation.results import Alignment
from hybridvo.geometry import invert
from hybridvo.trajectory import Trajectory, read_trajectory

__all__ = ["Comparison", "Path3D", "Series", "inside", "read_comparison", "shown_box"]

PAIR_NUMBERS = ("index", "epe_l2_px", "rot_err_deg", "trans_err", "ms")


@dataclass(frozen=True)
class Series:
    """A method with a source of flow: a colour and a dash pattern through the whole report.

    Args:
        method, flow_source: as in the rows.
        m: number of the method. f: number of the flow source.
    """

    method: str
    flow_source: str
    m: int
    f: int

    @property
    def label(self) -> str:
        """Text for legends."""
        return f"{self.method}, {self.flow_source}"


@dataclass(frozen=True, eq=False)
class Path3D:
    """A path in the first camera of the truth: x right, y down, z forward.

    Args:
        series: whose; None is the truth.
        positions: (N, 3) metres, aligned to the truth where there is one.
        error: position errors after the alignment, or None.
        timestamps: (N,) seconds.
    """

    series: Series | None
    positions: np.ndarray
    error: AbsoluteError | None
    timestamps: np.ndarray


@dataclass(frozen=True, eq=False)
class Comparison:
    """Content of a results folder.

    Args:
        folder: where it lies. result: ``results.json``.
        series: (method, flow source) -> Series, in the order of the rows.
        pairs: (sequence, method, flow source) -> columns of ``pairs.csv``, NaN where empty, and
            ``failed`` (0 or 1).
        paths: sequence -> paths, the truth first where it is known.
        headline: a line per series over all sequences.
        figures: what ``tools/visualize.py`` left.
    """

    folder: Path
    result: Mapping[str, Any]
    series: Mapping[tuple[str, str], Series]
    pairs: Mapping[tuple[str, str, str], Mapping[str, np.ndarray]]
    paths: Mapping[str, tuple[Path3D, ...]]
    headline: tuple[Mapping[str, Any], ...]
    figures: tuple[Mapping[str, Any], ...] = field(default=())

    @property
    def sequences(self) -> tuple[str, ...]:
        """Names in the order of the rows."""
        return tuple(dict.fromkeys(str(row["sequence"]) for row in self.result["rows"]))

    @property
    def flows(self) -> tuple[str, ...]:
        """Sources of flow in the order of the rows."""
        return tuple(dict.fromkeys(series.flow_source for series in self.series.values()))

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods in the order of the rows."""
        return tuple(dict.fromkeys(series.method for series in self.series.values()))

    @property
    def oracles(self) -> tuple[str, ...]:
        """What some estimates were given that no sensor gives."""
        rows = self.result["rows"]
        found = ["true flow"] if any("(true)" in str(row["flow_source"]) for row in rows) else []
        return (
            *found,
            *(["true depth"] if any(r.get("depth_source") == "true" for r in rows) else []),
        )


def read_comparison(folder: Path) -> Comparison:
    """Read a results folder.

    Args:
        folder: output of ``tools/compare_methods.py``.

    Raises:
        InputError: no ``results.json``. FormatError: a file is not as its writer leaves it.
    """
    result = _read_json(folder / "results.json")
    rows = result.get("rows")
    needed = ("sequence", "method", "flow_source")
    if (
        not isinstance(rows, list)
        or not rows
        or not all(isinstance(row, dict) and all(name in row for name in needed) for row in rows)
    ):
        raise FormatError(
            f"{folder / 'results.json'}: expected a list 'rows' of results with "
            f"{', '.join(needed)}, as tools/compare_methods.py writes it."
        )
    for row in rows:  # a method that was never run on a sequence has no flow
        row["flow_source"] = str(row["flow_source"] or "none")
    series = _series(rows)
    pairs = _read_pairs(folder / "pairs.csv")
    return Comparison(
        folder,
        result,
        series,
        pairs,
        _read_paths(folder, result.get("trajectories") or (), series),
        tuple(_headline(result, series, pairs)),
        tuple(_read_figures(folder)),
    )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such file; expected the output folder of tools/compare_methods.py."
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise FormatError(f"{path}: expected JSON, got something else: {error}.") from None
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected a JSON object, got {type(content).__name__}.")
    return content


def _series(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], Series]:
    keys = list(dict.fromkeys((str(row["method"]), str(row["flow_source"])) for row in rows))
    methods = list(dict.fromkeys(method for method, _ in keys))
    flows = list(dict.fromkeys(flow for _, flow in keys))
    return {
        key: Series(*key, methods.index(key[0]), flows.index(key[1]))
        for key in sorted(keys, key=lambda key: (methods.index(key[0]), flows.index(key[1])))
    }


def _number(text: str | None) -> float:
    return float(text) if text else math.nan


def _read_pairs(path: Path) -> dict[tuple[str, str, str], dict[str, np.ndarray]]:
    if not path.is_file():
        return {}
    lists: dict[tuple[str, str, str], list[tuple[float, ...]]] = {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                key = row["sequence"], row["method"], row["flow_source"] or "none"
                failed = float(row["status"].startswith("failed"))
                numbers = tuple(_number(row.get(name)) for name in PAIR_NUMBERS)
                lists.setdefault(key, []).append((failed, *numbers))
    except (KeyError, AttributeError, ValueError, OSError) as error:
        raise FormatError(
            f"{path}: not as tools/compare_methods.py writes it: {error!r}."
        ) from None
    return {
        key: dict(zip(("failed", *PAIR_NUMBERS), np.array(values).T, strict=True))
        for key, values in lists.items()
    }


def visible(text: str) -> str:
    """Text of characters that UTF-8 has and a reader sees; what is none becomes an escape."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: Any) -> str:
    """A message as one line of :func:`visible` characters."""
    return visible(" ".join(str(text).split()))


def plain_stem(name: str, longest: int = 100) -> str:
    """Part of a file's name that every file system takes: no separators, ``longest`` bytes."""
    plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name)
    return plain.encode("utf-8", "replace")[:longest].decode("utf-8", "ignore")


def inside(folder: Path, name: Any, what: str) -> Path:
    """A file of the folder; a report reads nothing outside of it."""
    path = (folder / str(name)).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise FormatError(f"{folder}: {what} '{name}' leads out of the folder.")
    if not path.is_file():
        raise FormatError(f"{folder}: {what} '{name}' is missing.")
    return path


def _read_paths(
    folder: Path, entries: Iterable[Mapping[str, Any]], series: Mapping[tuple[str, str], Series]
) -> dict[str, tuple[Path3D, ...]]:
    by_sequence: dict[str, list[Mapping[str, Any]]] = {}
    for entry in entries:
        by_sequence.setdefault(str(entry["sequence"]), []).append(entry)
    return {name: tuple(_paths_of(folder, found, series)) for name, found in by_sequence.items()}


def _paths_of(
    folder: Path, entries: list[Mapping[str, Any]], series: Mapping[tuple[str, str], Series]
) -> Iterable[Path3D]:
    def read(entry: Mapping[str, Any]) -> Trajectory:
        return read_trajectory(inside(folder, entry["path"], "trajectory"), "tum")

    truths = [entry for entry in entries if entry.get("method") is None]
    truth = read(truths[0]) if truths else None
    if truth is not None:
        T_first_world = invert(truth.T_world_cam[0])
        yield Path3D(None, truth.transformed(T_first_world).positions, None, truth.timestamps)
    for entry in entries:
        key = str(entry.get("method")), str(entry.get("flow_source"))
        if entry.get("method") is None or key not in series:
            continue
        found = read(entry)
        if truth is None:
            moved, error = found.transformed(invert(found.T_world_cam[0])), None
        else:
            fitted, error = align(found, truth)
            moved = fitted.transformed(T_first_world)
        yield Path3D(series[key], moved.positions, error, found.timestamps)


def align(est: Trajectory, truth: Trajectory) -> tuple[Trajectory, AbsoluteError | None]:
    """Estimate in the truth's world, rigidly, or by its first pose where a path is degenerate."""
    kinds: tuple[Alignment, ...] = ("se3", "origin")
    for kind in kinds:
        error = ate(est, truth, kind)
        if error.T_gt_est is not None:
            return est.transformed(error.T_gt_est, error.scale or 1.0), error
    return est.transformed(truth.T_world_cam[0] @ invert(est.T_world_cam[0])), None


def shown_box(paths: Iterable[Path3D]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner, (3,) metres each, of what is worth showing of some paths.

    All of them, but no more than twice the truth's extent beyond the truth: a method that runs away
    must not press the others into a dot. At least a millimetre, for a camera that stands still.
    """
    paths = list(paths)
    everything = np.concatenate([path.positions for path in paths])
    low, high = everything.min(axis=0), everything.max(axis=0)
    truth = next((path.positions for path in paths if path.series is None), None)
    if truth is not None:
        reach = max(2.0 * float(np.ptp(truth, axis=0).max()), 0.01)
        low = np.maximum(low, truth.min(axis=0) - reach)
        high = np.minimum(high, truth.max(axis=0) + reach)
    margin = 0.06 * max(float((high - low).max()), 1e-3)
    return low - margin, high + margin


def _quartiles(values: np.ndarray) -> tuple[float | None, float | None, float | None]:
    known = values[np.isfinite(values)]
    if not known.size:
        return None, None, None
    low, middle, high = (float(x) for x in np.quantile(known, (0.25, 0.5, 0.75)))
    return low, middle, high


def _headline(
    result: Mapping[str, Any],
    series: Mapping[tuple[str, str], Series],
    pairs: Mapping[tuple[str, str, str], Mapping[str, np.ndarray]],
) -> Iterable[dict[str, Any]]:
    """Medians over all pairs of all sequences; trajectory errors as means over sequences.

    What ``totals`` says comes first; the quartiles, and all of it where there are none, is found
    in the pairs and rows.
    """
    rates = {
        (rate["method"], rate["flow_source"]): rate
        for rate in (result.get("breakdown") or {}).get("failure_rates", ())
    }
    totals = {
        (str(row["method"]), str(row["flow_source"] or "none")): dict(row)
        for row in result.get("totals") or ()
    }
    for key, one in series.items():
        rows = [r for r in result["rows"] if (str(r["method"]), str(r["flow_source"])) == key]
        columns = [values for (_, *rest), values in pairs.items() if tuple(rest) == key]
        line: dict[str, Any] = {
            "series": one,
            "method": key[0],
            "flow_source": key[1],
            "pairs": sum(row.get("pairs") or 0 for row in rows),
            "failed": sum(row.get("failed") or 0 for row in rows),
        }
        for name in ("failure_rate", "failure_rate_low", "failure_rate_high"):
            line[name] = rates.get(key, {}).get(name)
        for name in PAIR_NUMBERS[1:]:
            values = np.concatenate([c[name] for c in columns]) if columns else np.zeros(0)
            line[f"{name}_q25"], line[f"{name}_median"], line[f"{name}_q75"] = _quartiles(values)
            line[f"{name}_pairs"] = int(np.isfinite(values).sum())
        for name in ("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg"):
            known = [row[name] for row in rows if row.get(name) is not None]
            line[name] = float(np.mean(known)) if known else None
        yield line | totals.get(key, {}) | {"series": one, "flow_source": key[1]}


def _read_figures(folder: Path) -> Iterable[dict[str, Any]]:
    for path in sorted((folder / "figures").glob("*.json")):
        try:
            figure = _read_json(path)
            figure["file"] = inside(folder, figure["picture"], "figure")
        except KeyError:
            raise FormatError(f"{path}: expected the key 'picture'.") from None
        except HybridVOError:
            raise
        yield figure
