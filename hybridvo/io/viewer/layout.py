"""How the viewer is arranged when it opens."""

from __future__ import annotations

from typing import Any

from hybridvo.io.viewer import scene


def blueprint() -> Any:
    """Return a ``rerun.blueprint.Blueprint``: scene and image above, curves below."""
    import rerun.blueprint as rrb

    # the path is drawn from its beginning to the time that is shown
    so_far = [
        rrb.VisibleTimeRange(
            timeline,
            start=rrb.TimeRangeBoundary.infinite(),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        for timeline in ("frame", "time")
    ]
    world = rrb.Spatial3DView(
        name="path, points, 3 sigma",
        origin="world",
        overrides={scene.PATH: rrb.VisibleTimeRanges(so_far)},
    )
    image = rrb.Spatial2DView(name="image, orange: moves", origin=scene.IMAGE)
    maps = rrb.Tabs(
        rrb.Spatial2DView(name="weights", origin=scene.WEIGHTS),
        rrb.Spatial2DView(name="flow", origin=scene.FLOW),
        rrb.TextLogView(name="messages", origin=scene.MESSAGES),
    )
    sigma = rrb.TimeSeriesView(name="sigma of a step", origin="sigma/translation")
    curves = rrb.Horizontal(
        rrb.Vertical(
            rrb.StateTimelineView(name="status", origin=scene.STATE),
            _curve("probability", scene.PROBABILITY, rrb, (0.0, 1.0)),
        ),
        rrb.Vertical(sigma, _curve("sigma of rotation", scene.ROTATION, rrb)),
        rrb.Vertical(
            _curve("sigma since the start", scene.POSITION, rrb),
            _curve("rate", scene.RATE, rrb),
        ),
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(world, rrb.Vertical(image, maps), column_shares=[3, 2]),
            curves,
            row_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _curve(
    name: str, origin: str, rrb: Any, range_y: tuple[float, float] | None = None
) -> Any:
    """Return a view of one curve; its axis fits itself where no range is given."""
    axis = None if range_y is None else rrb.ScalarAxis(range=range_y)
    return rrb.TimeSeriesView(name=name, origin=origin, axis_y=axis)
