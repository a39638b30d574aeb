"""How the viewer is arranged when it opens."""

from __future__ import annotations

from typing import Any

from hybridvo.io.viewer import scene

PROBABLE = (0.0, 1.05)
"""Range of the axis of a probability, with room above certainty."""


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
    curves = rrb.Horizontal(
        rrb.Vertical(
            rrb.StateTimelineView(name="status", origin=scene.STATE),
            _curve(
                "probability that the motion is right", scene.PROBABILITY, PROBABLE
            ),
        ),
        rrb.Vertical(
            _curve("sigma of a step, translation [mm]", scene.TRANSLATION),
            _curve("sigma of a step, rotation [mdeg]", scene.ROTATION),
        ),
        rrb.Vertical(
            _curve("sigma of the position since the start [mm]", scene.POSITION),
            _curve("frames a second", scene.RATE),
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
    name: str, origin: str, range_y: tuple[float, float] | None = None
) -> Any:
    """Return a view of one curve; its axis fits itself where no range is given."""
    import rerun.blueprint as rrb

    axis = None if range_y is None else rrb.ScalarAxis(range=range_y)
    legend = rrb.PlotLegend(visible=False)
    return rrb.TimeSeriesView(
        name=name, origin=origin, axis_y=axis, plot_legend=legend
    )
