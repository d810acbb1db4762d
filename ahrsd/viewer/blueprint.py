"""What a person sees on opening a recording: entity names, their styles, the layout of views.

The layout reads from left to right: what the sensor measures (3D), whether a write is allowed
(gates, states), how sure the estimate is (time series), and what happened (log).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

Colour = tuple[int, int, int]

RAW: Colour = (235, 125, 40)  # orange: as the sensor reads it
CORRECTED: Colour = (60, 150, 255)  # blue: with the newest estimate's correction
X: Colour = (230, 80, 80)
Y: Colour = (90, 190, 90)
Z: Colour = (90, 140, 250)
GREY: Colour = (150, 150, 150)
OK: Colour = (60, 170, 90)
NOT_OK: Colour = (205, 70, 60)

RAW_POINTS = "field/raw/points"
RAW_ELLIPSOID = "field/raw/ellipsoid"
CORRECTED_POINTS = "field/corrected/points"
CORRECTED_SPHERE = "field/corrected/sphere"
FIELD_AXES = "field/axes"
FIELD_NORM = "field_norm_gauss"
GYRO = "gyro_b_rad_s"
HARD_IRON = "estimate/hard_iron_gauss"
SOFT_IRON = "estimate/soft_iron_minus_identity"
GYRO_BIAS = "estimate/gyro_bias_mrad_s"
HEADING_SIGMA = "estimate/heading_sigma_deg"
GATE_TABLE = "gate_table"
GATE_LANES = "gate"
STATE_LANE = "daemon/state"
LOG = "log"

DEVICE_TIME = "device_time"  # of the device's clock, going on where the device restarted
HOST_TIME = "host_time"  # the host's monotonic clock
SAMPLE = "sample"  # counts samples since the sink was made

POINT_COLOURS = {RAW_POINTS: RAW, CORRECTED_POINTS: CORRECTED}
SHOWN_POINTS_S = 60.0  # 3D shows the newest minute: at most 3000 points a cloud at 50 a second

_WATCHING: Colour = (120, 120, 130)
_WRITING: Colour = (220, 180, 60)
_BAD: Colour = (205, 70, 60)
STATE_COLOURS: dict[str, Colour] = {
    "RECONCILING": _WATCHING,
    "OBSERVING": _WATCHING,
    "CANDIDATE": (90, 140, 210),
    "QUALIFIED": (70, 180, 200),
    "PREPARING": _WRITING,
    "CHECKING": _WRITING,
    "STAGING": _WRITING,
    "STAGED": _WRITING,
    "TRIAL": (230, 150, 50),
    "PROVEN": (120, 190, 90),
    "SET_ASIDE": _WRITING,
    "SAVE_PREPARING": _WRITING,
    "SAVING": _WRITING,
    "COMMITTED": (60, 170, 90),
    "CONFIRMED": (40, 150, 80),
    "ROLLING_BACK": _BAD,
    "ROLLED_BACK": _BAD,
    "FAULT": _BAD,
    "FLASH_TORN": _BAD,
    "LOCKED": (150, 40, 90),
}


@dataclass(frozen=True, slots=True)
class Band:
    """One estimated number, drawn as three lines: the value, and the value -+ one sigma."""

    name: str
    colour: Colour


BANDS: dict[str, tuple[Band, ...]] = {
    HARD_IRON: (Band("x", X), Band("y", Y), Band("z", Z)),
    GYRO_BIAS: (Band("x", X), Band("y", Y), Band("z", Z)),
    SOFT_IRON: (
        Band("xx", X),
        Band("xy", (215, 170, 60)),
        Band("xz", (200, 90, 200)),
        Band("yy", Y),
        Band("yz", (80, 200, 200)),
        Band("zz", Z),
    ),
}


def _band_lines(bands: Sequence[Band]) -> rr.SeriesLines:
    names = [band.name for band in bands for _ in range(3)]
    faint = [(*band.colour, 110) for band in bands]
    colours = [
        c for band, low in zip(bands, faint, strict=True) for c in ((*band.colour, 255), low, low)
    ]
    return rr.SeriesLines(names=names, colors=colours, widths=[2.0, 1.0, 1.0] * len(bands))


def log_styles(stream: rr.RecordingStream) -> None:
    """Log what never changes: names and colours of series, the state's lane, the axes."""
    for path, bands in BANDS.items():
        stream.log(path, _band_lines(bands), static=True)
    lines = {
        GYRO: rr.SeriesLines(names=["x", "y", "z"], colors=[X, Y, Z], widths=[1.0] * 3),
        FIELD_NORM: rr.SeriesLines(
            names=["registers in place", "newest estimate"],
            colors=[RAW, CORRECTED],
            widths=[1.5, 1.5],
        ),
        HEADING_SIGMA: rr.SeriesLines(names=["worst heading"], colors=[CORRECTED], widths=[2.0]),
    }
    for path, style in lines.items():
        stream.log(path, style, static=True)
    stream.log(STATE_LANE, states_style(STATE_COLOURS), static=True)
    stream.log("field", rr.ViewCoordinates.FRD, static=True)
    stream.log(
        FIELD_AXES,
        rr.Arrows3D(
            vectors=[[0.25, 0, 0], [0, 0.25, 0], [0, 0, 0.25]],
            colors=[X, Y, Z],
            labels=["x forward", "y right", "z down"],
            radii=-1.5,
        ),
        static=True,
    )


def states_style(colours: dict[str, Colour]) -> rr.StateConfiguration:
    """Colours of a lane's states."""
    return rr.StateConfiguration(values=list(colours), colors=[(*c, 255) for c in colours.values()])


def gate_path(gate: str) -> str:
    """Entity of a gate's lane; what a path would have to escape becomes an underscore."""
    return f"{GATE_LANES}/{re.sub(r'[^0-9A-Za-z_.-]', '_', gate)}"


def _newest(seconds: float) -> rrb.VisibleTimeRanges:
    return rrb.VisibleTimeRanges(
        [
            rr.VisibleTimeRange(
                timeline,
                start=rr.TimeRangeBoundary.cursor_relative(seconds=-seconds),
                end=rr.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (DEVICE_TIME, HOST_TIME)
        ]
    )


def _whole_recording() -> rrb.TimeAxis:
    return rrb.TimeAxis(
        link=rrb.components.LinkAxis.Independent,
        view_range=rr.TimeRange(
            start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
        ),
    )


def _series(path: str, title: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=path,
        name=title,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        axis_x=_whole_recording(),
    )


def blueprint() -> rrb.Blueprint:
    """Build the default layout; it is stored in the file, so nobody has to arrange views."""
    field = rrb.Spatial3DView(
        origin="field",
        name="Magnetic field [gauss]: raw (orange) on its ellipsoid, corrected (blue) on a sphere",
        overrides={path: _newest(SHOWN_POINTS_S) for path in (RAW_POINTS, CORRECTED_POINTS)},
        line_grid=False,
    )
    left = rrb.Vertical(
        field,
        rrb.TextLogView(
            origin=LOG,
            name="Log: states, register writes, notes",
            columns=rrb.TextLogColumns(
                timeline_columns=[DEVICE_TIME], text_log_columns=["LogLevel", "Body"]
            ),
        ),
        row_shares=[7, 4],
    )
    middle = rrb.Vertical(
        rrb.TextDocumentView(origin=GATE_TABLE, name="Gates: may a calibration be written now?"),
        rrb.StateTimelineView(
            contents=[f"/{STATE_LANE}", f"/{GATE_LANES}/**"],
            name="State of the write-back, and each gate",
            time_view=_whole_recording(),
        ),
        row_shares=[5, 6],
    )
    right = rrb.Vertical(
        _series(HARD_IRON, "Hard iron [gauss] ± sigma"),
        _series(SOFT_IRON, "Soft iron minus identity ± sigma"),
        _series(GYRO_BIAS, "Gyro bias [mrad/s] ± sigma"),
        _series(HEADING_SIGMA, "Heading error expected (1 sigma) [deg]"),
        rrb.Tabs(
            _series(FIELD_NORM, "Field strength [gauss]"),
            _series(GYRO, "Gyro [rad/s]"),
        ),
        row_shares=[4, 5, 4, 4, 4],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, middle, right, column_shares=[4, 4, 4]),
        rrb.TimePanel(state="collapsed", timeline=DEVICE_TIME, play_state="following"),
        collapse_panels=True,
        auto_views=False,
    )
