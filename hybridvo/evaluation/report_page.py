"""The report of a comparison: ``report.html`` and ``report.md`` from the other files of its folder.

:func:`write_report` needs nothing but the folder, so a report can be made again at any time, and
is all that ``tools/compare_methods.py`` calls. It reads

``results.json``
    as :mod:`hybridvo.evaluation.breakdown` and :mod:`hybridvo.evaluation.protocols` describe it:
    ``command``, ``versions``, ``machine``, ``missing``, ``rows``; where they are there also
    ``breakdown``, ``worst_pairs``, ``protocol``, ``weights`` (method -> what is known of its
    weights), and ``trajectories``: a list of ``sequence``, ``method`` and ``flow_source`` (both
    null for the truth) and ``path``, a TUM file relative to the folder;
``pairs.csv``
    a row per pair and method: errors over time and times;
``figures/*.json``
    what ``tools/visualize.py --into FOLDER`` left: ``title``, ``caption``, ``numbers`` (a list of
    ``label`` and ``value``), and ``picture``, a PNG or JPEG file relative to the folder.

Everything but ``results.json`` may be absent; what is absent is left out of the page.
"""

from __future__ import annotations

import base64
import os
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.errors import FormatError
from hybridvo.evaluation.breakdown import FAILURE_PX
from hybridvo.evaluation.report import MISSING
from hybridvo.evaluation.report_data import Comparison, inside, one_line, read_comparison
from hybridvo.evaluation.report_tables import (
    headline_table,
    number,
    plain_markdown,
    protocol_table,
    published_table,
    sequence_table,
)
from hybridvo.files import atomic_write

__all__ = ["write_report"]

_MEDIA = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
REFERENCES = ("hybrid", "hybrid-flow", "refine")
"""Methods that others are set against: the first of these that ran, else the first of all."""


def write_report(folder: str | os.PathLike[str]) -> list[Path]:
    """Write ``report.html`` (one self-contained file) and ``report.md`` into a results folder.

    Args:
        folder: output of ``tools/compare_methods.py``.

    Returns:
        The files written.

    Raises:
        InputError: no ``results.json``. FormatError: a file that is not as described above.
        OutputError: a file cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    folder = Path(folder)
    comparison = read_comparison(folder)
    try:
        content = _content(comparison)
    except (KeyError, TypeError, AttributeError) as error:
        raise FormatError(
            f"{folder / 'results.json'}: not as tools/compare_methods.py writes it: {error!r}."
        ) from error
    environment = Environment(
        loader=PackageLoader("hybridvo.evaluation"),
        autoescape=lambda name: name is not None and name.endswith(".html.jinja"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["plain"] = plain_markdown
    written = []
    for name in ("report.html", "report.md"):
        text = environment.get_template(f"{name}.jinja").render(content)
        # a path or a message may hold what is no UTF-8
        content_bytes = (text.rstrip() + "\n").encode("utf-8", "backslashreplace")
        with atomic_write(folder / name, "wb") as file:
            file.write(content_bytes)
        written.append(folder / name)
    return written


def _content(comparison: Comparison) -> dict[str, Any]:
    """What the templates show."""
    from hybridvo.evaluation.plots_comparison import PALETTE

    result = comparison.result
    names = comparison.sequences
    sequences = [_sequence(comparison, name, k) for k, name in enumerate(names)]
    first = f"{names[0]}" if len(names) == 1 else f"{len(names)} sequences"
    return {
        "comparison": comparison,
        "title": f"Camera motion on {first}",
        "palette": PALETTE,
        "failure_px": FAILURE_PX,
        "pairs": max((line["pairs"] for line in comparison.headline), default=0),
        "headline": headline_table(comparison),
        "rows": sequence_table(comparison),
        "protocol": result.get("protocol") or None,
        "protocol_table": protocol_table(comparison),
        "published": published_table(comparison),
        "sequences": sequences,
        "breakdown": _breakdown(comparison),
        "timing": _timing(comparison),
        "gallery": _gallery(comparison),
        "figures": [{**figure, "src": _picture(figure["file"])} for figure in comparison.figures],
        "provenance": _provenance(result),
        "command": _command(result.get("command")),
        "missing": result.get("missing") or {},
        "remarks": _remarks(result.get("sequences") or ()),
        "MISSING": MISSING,
    }


def _command(command: Any) -> str:
    if isinstance(command, str):
        return command
    return one_line(shlex.join(str(x) for x in command or ()))


def _remarks(sequences: Iterable[Mapping[str, Any]]) -> list[str]:
    """What readers noticed, and the pairs that are not in the figures: sequence by sequence."""
    found = []
    for sequence in sequences:
        name = sequence["name"]
        found += [
            f"{name}: {notice}"
            for notice in sequence.get("notices") or ()
            if "natural order" not in notice  # true of most data sets, and no surprise
        ]
        left_out = sequence.get("left_out") or []
        absent = max(0, sequence["frames"] - 1) - sequence["pairs"]
        if left_out and absent > 0:
            first = f"first, frame {left_out[0]['index']}: {left_out[0]['reason']}"
            found.append(f"{name}: {absent} of {sequence['frames'] - 1} pairs left out; {first}")
        elif sequence["pairs"] == 0:
            found.append(f"{name}: no pair of frames: {sequence['frames']} frame in the range")
    return [one_line(line) for line in found]


def _markup(svg: str) -> Any:
    from markupsafe import Markup

    return Markup(svg)  # made by our own plots, which escape every name


def _sequence(comparison: Comparison, name: str, number_: int) -> dict[str, Any]:
    """Plots of one sequence."""
    from hybridvo.evaluation.plots_comparison import error_svg, top_view_svg
    from hybridvo.evaluation.report_view3d import view_svg

    paths = comparison.paths.get(name, ())
    plots = []
    if paths:
        plots.append(
            ("Path from above", top_view_svg(paths, f"{name}: path from above", f"t{number_}"))
        )
        plots.append(("Path in 3-D: drag, or use the arrow keys", view_svg(paths, f"{name}: path")))
    start = min((float(p.timestamps[0]) for p in paths if len(p.timestamps)), default=0.0)
    lines = [
        (p.series, p.error.timestamps - start, p.error.errors)
        for p in paths
        if p.series is not None
        and p.error is not None
        and p.error.errors is not None
        and p.error.timestamps is not None
    ]
    if lines:
        labels = "time [s]", "position error [m]"
        svg = error_svg(lines, labels, f"{name}: position error", f"p{number_}")
        plots.append(("Position error of the aligned path", svg))
    errors = [
        (series, columns["index"], columns["epe_l2_px"])
        for key, series in comparison.series.items()
        if (columns := comparison.pairs.get((name, *key))) is not None
        and np.isfinite(columns["epe_l2_px"]).any()
    ]
    if errors:
        labels = "frame", "EPE [px]"
        svg = error_svg(
            errors, labels, f"{name}: error of each pair", f"e{number_}", limit=FAILURE_PX
        )
        plots.append(("Error of the ego flow, pair by pair", svg))
    return {"name": name, "plots": [(caption, _markup(svg)) for caption, svg in plots]}


def _reference(comparison: Comparison) -> str:
    ran = comparison.methods
    return next((name for name in REFERENCES if name in ran), ran[0])


def _breakdown(comparison: Comparison) -> dict[str, Any] | None:
    from hybridvo.evaluation.plots_comparison import difference_svg, factor_svg, failure_svg

    found = comparison.result.get("breakdown")
    if not found:
        return None
    series = comparison.series
    plots = []
    if any(rate["failure_rate"] is not None for rate in found["failure_rates"]):
        svg = failure_svg(found["failure_rates"], series, "failure rates", "fr")
        plots.append(("How often an estimate fails or is wrong by more than a pixel", svg))
    reference = _reference(comparison)
    if any(
        row["epe_ratio"] is not None and reference in (row["method"], row["other"])
        for row in found["differences"]
    ):
        svg = difference_svg(found["differences"], reference, series, "paired differences", "pd")
        plots.append((f"Errors of the other methods over those of {reference}, pair by pair", svg))
    unknown = []
    for k, factor in enumerate(found["factors"]):
        cells = [cell for cell in found["cells"] if cell["factor"] == factor["name"]]
        if not cells:
            unknown.append((factor["label"], factor["reason"] or "no pair has it"))
            continue
        svg = factor_svg(factor, cells, series, f"errors against {factor['label']}", f"b{k}")
        plots.append((f"Errors against the {factor['label']}", svg))
    return {
        "plots": [(caption, _markup(svg)) for caption, svg in plots],
        "unknown": unknown,
        "bootstrap": found.get("bootstrap") or {},
    }


def _timing(comparison: Comparison) -> list[tuple[str, Any]]:
    from hybridvo.evaluation.plots_comparison import duration_svg, timing_svg

    lines = [line for line in comparison.headline if line["ms_median"] is not None]
    if not lines:
        return []
    plots = [("Time per pair", duration_svg(lines, "time per pair", "td"))]
    if any(line["epe_l2_px_median"] is not None for line in lines):
        plots.append(("Error against time", timing_svg(lines, "error against time", "tm")))
    return [(caption, _markup(svg)) for caption, svg in plots]


def _picture(path: Path) -> str:
    """A picture as a data URL."""
    media = _MEDIA.get(path.suffix.lower())
    if media is None:
        raise FormatError(f"{path}: expected a picture ({', '.join(_MEDIA)}).")
    return f"data:{media};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _gallery(comparison: Comparison) -> list[dict[str, Any]]:
    """Worst pairs by method and flow; a picture that several share is kept once."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for pair in comparison.result.get("worst_pairs") or ():
        key = str(pair["method"]), str(pair["flow_source"] or "none")
        if key not in comparison.series:
            continue
        name = pair.get("picture")
        path = None if name is None else inside(comparison.folder, name, "picture")
        source = None if path is None else _picture(path)
        groups.setdefault(key, []).append({**pair, "src": source})
    return [{"series": comparison.series[key], "pairs": pairs} for key, pairs in groups.items()]


def _provenance(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Facts about the run, flat."""

    def flat(value: Any) -> str:
        if isinstance(value, Mapping):
            return ", ".join(f"{k} {flat(v)}" for k, v in value.items())
        if isinstance(value, (list, tuple)):
            return ", ".join(flat(item) for item in value)
        return MISSING if value is None else one_line(value)

    known: Iterable[tuple[str, str]] = (
        ("versions", "versions"),
        ("machine", "machine"),
        ("weights", "weights"),
        ("options", "options"),
        ("commit", "commit"),
        ("started", "started"),
        ("finished", "finished"),
    )
    rows = [(label, flat(result[key])) for key, label in known if result.get(key)]
    depth = sorted({str(row["depth_source"]) for row in result["rows"] if row.get("depth_source")})
    rows.append(("depth", ", ".join(depth) or "unknown"))
    if result.get("weights") == {}:  # where the key is absent, nobody noted them
        rows.append(("weights", "no method used a network"))
    return rows
