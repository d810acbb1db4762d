"""Rows about the data: the stream, what it rests on, the motion, the field."""

from __future__ import annotations

from ahrsd.gates.row import Level, least, most, no, yes

_MOVE = "drive at least two full circles in calm surroundings"
_TILT = "pitch and roll by 30 deg if the vehicle can"
_SEEN = "({e.motion.tilts})"
_NO_TILT = "tilt is not known: {e.motion.turn}"

STREAM = (
    most(
        "stream_health.errors",
        "G0",
        "health.crc_error_rate",
        "",
        "max_error_rate",
        Level.CANDIDATE,
        meaning="messages with a wrong checksum, over all",
        advice="{v:.2g} of the messages are damaged (limit {l:.2g}): check cable and baud rate",
    ),
    most(
        "stream_health.drops",
        "G0",
        "health.drop_rate",
        "",
        "max_drop_rate",
        Level.CANDIDATE,
        meaning="samples missing, over all",
        advice="{v:.2g} of the samples are missing (limit {l:.2g}): raise the baud rate, lower "
        "the output rate, or set the USB latency timer to 1 ms",
    ),
    most(
        "stream_health.saturated",
        "G0",
        "health.saturated",
        "samples",
        0.0,
        Level.CANDIDATE,
        meaning="samples at the end of the sensor's range or unusable",
        advice="{v:.0f} samples are saturated or unusable: look for a magnet, or move slower",
    ),
    most(
        "stream_health.time",
        "G0",
        "health.negative_dt",
        "",
        0.0,
        Level.CANDIDATE,
        meaning="times at which the device's clock went backwards",
        advice="the device's clock went back ({v:.0f} x): it was reset; start again",
    ),
    least(
        "stream_health.rate",
        "G0",
        "health.rate_hz",
        "Hz",
        "min_rate_hz",
        Level.CANDIDATE,
        meaning="sample rate",
        advice="{v:.1f} samples per second are too few (limit {l:.1f}): raise the output rate",
        missing="no samples have been counted yet",
    ),
    yes(
        "input_basis.registers_read",
        "G1",
        "basis.registers_read",
        Level.CANDIDATE,
        meaning="the compensation registers were read",
        advice="the registers are not known: leave passive mode, or give them for a recording",
    ),
    no(
        "input_basis.changed",
        "G1",
        "basis.changed",
        Level.CANDIDATE,
        meaning="a compensation register changed while the data were taken",
        advice="a compensation register was changed meanwhile: start again, and let no other "
        "program write to the device",
    ),
    no(
        "input_basis.hsi_applied",
        "G1",
        "basis.hsi_applied",
        Level.CANDIDATE,
        meaning="the on-board hard/soft iron estimator acts on the output",
        advice="the device's own HSI estimator is applied: set register 44 to 0,1,5",
    ),
    no(
        "input_basis.compensated_only",
        "G1",
        "basis.compensated_only",
        Level.CANDIDATE,
        meaning="the stream has compensated values only, and what was done to them is unknown",
        advice="the stream has only compensated values: use VNIMU or binary UncompMag",
    ),
    yes(
        "input_basis.firmware_known",
        "G1",
        "basis.firmware_known",
        Level.CANDIDATE,
        meaning="the firmware is one whose registers are known",
        advice="this firmware is unknown: nothing is written to it",
    ),
)

MOTION = (
    yes(
        "motion.regime",
        "G2",
        "motion_known",
        Level.CANDIDATE,
        meaning="there was motion (3D, planar or between) and gravity to see it by",
        advice=f"motion: {{e.motion.regime}}; {_MOVE} ({{e.motion.turn}})",
    ),
    least(
        "motion.heading",
        "G2",
        "motion.heading_deg",
        "deg",
        "min_heading_excursion_deg",
        Level.CANDIDATE,
        meaning="headings shown, in sectors of 10 deg",
        advice="{v:.0f} of {l:.0f} deg of heading are covered: {e.motion.turn}",
        missing=_NO_TILT,
    ),
    least(
        "motion.planar_circle",
        "G2",
        "motion.heading_deg",
        "deg",
        "min_planar_circle_deg",
        Level.CANDIDATE,
        meaning="the same where the motion is planar: the whole circle is needed",
        advice=f"flat motion needs a full circle, {{v:.0f}} of {{l:.0f}} deg are covered: "
        f"{{e.motion.turn}}, or {_TILT}",
        applies="planar",
    ),
    yes(
        "observability.converged",
        "G3",
        "estimate.converged",
        Level.CANDIDATE,
        meaning="the estimator says that it has converged",
        advice=f"the estimate has not converged: {_MOVE}; {_TILT} {_SEEN}",
    ),
    least(
        "observability.score",
        "G3",
        "estimate.score",
        "",
        "min_observability",
        Level.CANDIDATE,
        meaning="weakest direction of the information, 1 = just enough",
        advice=f"the motion does not determine everything ({{v:.2g}} of {{l:.2g}}): {_TILT} "
        f"{_SEEN}",
        missing="the estimator has no answer yet",
    ),
    most(
        "observability.heading_sigma",
        "G3",
        "estimate.heading_sigma_deg",
        "deg",
        "max_heading_sigma_deg",
        Level.CANDIDATE,
        meaning="expected heading error (1 sigma) at the worst attitude driven",
        advice=f"the heading is not known well enough (limit {{l:.1f}} deg): {_MOVE}; {_TILT} "
        f"{_SEEN}",
        missing="the estimator has no answer yet",
    ),
    most(
        "observability.held",
        "G3",
        "change.moved_unseen_gauss",
        "gauss",
        "max_moved_unseen_gauss",
        Level.CANDIDATE,
        meaning="move of the vertical hard iron although the motion was too flat to see it",
        advice=f"the vertical hard iron moved by {{v:.3f}} gauss on flat motion: {_TILT} {_SEEN}",
        missing=_NO_TILT,
    ),
)

FIELD = (
    most(
        "field.spread_ram",
        "G4",
        "spread_percent",
        "%",
        "field_spread_ram_percent",
        Level.RAM,
        meaning="standard deviation of the corrected field over its mean",
        advice="the corrected field varies by {v:.1f} % (limit {l:.1f}): go away from steel and "
        "cables, keep phones and tools away, then turn again",
        missing="no segment is complete yet",
    ),
    most(
        "field.spread_flash",
        "G4",
        "spread_percent",
        "%",
        "field_spread_flash_percent",
        Level.FLASH,
        meaning="the same, to save for good",
        advice="the corrected field varies by {v:.1f} % (limit {l:.1f} to save): repeat it in "
        "the open, away from steel and cables",
        missing="no segment is complete yet",
    ),
    least(
        "field.weakest",
        "G4",
        "field.min_gauss",
        "gauss",
        "field_min_gauss",
        Level.RAM,
        meaning="smallest corrected field; nowhere on Earth is it weaker than the limit",
        advice="the corrected field falls to {v:.2f} gauss (on Earth at least {l:.2f}): a "
        "magnet is near, or the scale in register 23 is wrong",
        missing="no segment is complete yet",
    ),
    most(
        "field.strongest",
        "G4",
        "field.max_gauss",
        "gauss",
        "field_max_gauss",
        Level.RAM,
        meaning="largest corrected field; nowhere on Earth is it stronger than the limit",
        advice="the corrected field reaches {v:.2f} gauss (on Earth at most {l:.2f}): a magnet "
        "is near, or the scale in register 23 is wrong",
        missing="no segment is complete yet",
    ),
    yes(
        "field.position",
        "G4",
        "position_known",
        Level.FLASH,
        meaning="position and date are configured, so that the world model can judge",
        advice="set the location in the configuration: nothing is saved for good without it",
    ),
    most(
        "field.model",
        "G4",
        "model_error_percent",
        "%",
        "field_model_percent",
        Level.RAM,
        meaning="mean corrected field against the world model",
        advice="the field is {v:.0f} % off the world model (limit {l:.0f}): check the location, "
        "or go away from steel",
        missing="no segment is complete yet",
        applies="position_known",
    ),
    most(
        "field.inclination",
        "G4",
        "world.inclination_error_deg",
        "deg",
        "max_inclination_error_deg",
        Level.RAM,
        meaning="dip of the corrected field against the world model",
        advice=f"the dip is {{v:.1f}} deg off the world model (limit {{l:.1f}}): check the "
        f"location; go away from steel; {_TILT} {_SEEN}",
        missing="the dip is not known: drive some time without hard manoeuvres",
        applies="position_known",
    ),
)
