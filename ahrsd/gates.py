"""What must hold before a calibration is written: limits, the table of gates, and its judge.

Guards (`Level`): CANDIDATE - it may be shown; RAM - an operator may approve it; FLASH - it may be
saved; UNATTENDED - RAM without an operator. For a field engineer: docs/reference/gates.md.

The table has one row per number that is judged; docs/reference/gates.md is checked against it.
`value` is the path of a number or of a yes/no in Evidence (yes = 1), `limit` the name of a limit in
GateLimits or a number. In `advice`, {v} is the value, {l} the limit, {e} the whole evidence.
`applies` names a property of Evidence; where it is false, the row does not exist.

Judging fails closed: a number that is not finite is not ok, whatever its row says, and a row of the
table that is not among the results counts as red.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from operator import attrgetter

from ahrsd.events import GateResult
from ahrsd.evidence.values import CIRCLES, Evidence

# -- Limits ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class GateLimits:
    """One limit per row of the table; docs/reference/gates.md says why each is what it is."""

    max_error_rate: float = 1e-3  # of messages
    max_drop_rate: float = 5e-3  # of samples
    min_rate_hz: float = 10.0
    min_heading_excursion_deg: float = 280.0
    min_planar_circle_deg: float = 340.0
    min_observability: float = 1.0
    max_heading_sigma_deg: float = 1.0
    max_moved_unseen_gauss: float = 0.02
    field_min_gauss: float = 0.22
    field_max_gauss: float = 0.67
    field_model_percent: float = 10.0
    field_spread_ram_percent: float = 2.0
    field_spread_flash_percent: float = 1.0
    max_inclination_error_deg: float = 3.0
    max_place_deg: float = 0.03
    holdout_segments: float = 2.0
    min_holdout_excursion_deg: float = 280.0
    holdout_rms_deg: float = 1.5
    holdout_max_deg: float = 3.0
    closure_deg: float = 2.0
    min_improvement_percent: float = 20.0
    min_improvement_deg: float = 0.3
    min_improvement_lower_deg: float = 0.01
    repeat_hard_iron_gauss: float = 0.01
    repeat_heading_deg: float = 1.0
    second_opinion_deg: float = 2.0
    min_eigenvalue: float = 0.05
    min_diagonal: float = 0.2
    max_diagonal: float = 5.0
    max_condition_auto: float = 2.0
    max_condition_operator: float = 8.0
    max_offset_auto_gauss: float = 0.6
    max_offset_operator_gauss: float = 1.3
    max_scale_change_percent: float = 5.0
    max_step_auto_deg: float = 5.0
    max_step_operator_deg: float = 20.0
    max_field_change_gauss: float = 0.05
    max_inclination_change_deg: float = 2.0
    max_temperature_drift_c: float = 5.0
    max_gyro_bias_deg_s: float = 3.0
    min_rest_s: float = 3.0
    max_gyro_sigma_share: float = 1.0 / 3.0
    max_gyro_disagreement: float = 4.0
    max_gyro_apart_mrad_s: float = 1.2

    def with_margin(self, margin: float) -> GateLimits:
        """After a rollback: an improvement must be `margin` times as clear."""
        return replace(
            self,
            min_improvement_percent=min(self.min_improvement_percent * margin, 95.0),
            min_improvement_deg=self.min_improvement_deg * margin,
            min_improvement_lower_deg=self.min_improvement_lower_deg * margin,
        )


# -- The table -------------------------------------------------------------------------------------


class Level(IntEnum):
    """What a row guards; each level needs those below it. UNATTENDED: to write without a person."""

    CANDIDATE = 0
    RAM = 1
    FLASH = 2
    UNATTENDED = 3


@dataclass(frozen=True, slots=True)
class Gate:
    """One row. `code`: the gate's family, G0 to G12."""

    gate: str
    code: str
    value: str
    unit: str
    limit: str | float
    at_most: bool
    level: Level
    meaning: str
    advice: str
    missing: str = "this could not be measured"
    applies: str = ""


def most(
    gate: str, code: str, value: str, unit: str, limit: str | float, level: Level, **words: str
) -> Gate:
    """A row that holds up to its limit."""
    return Gate(gate, code, value, unit, limit, at_most=True, level=level, **words)


def least(
    gate: str, code: str, value: str, unit: str, limit: str | float, level: Level, **words: str
) -> Gate:
    """A row that holds from its limit on."""
    return Gate(gate, code, value, unit, limit, at_most=False, level=level, **words)


def yes(gate: str, code: str, value: str, level: Level, **words: str) -> Gate:
    """A row that must be true."""
    return Gate(gate, code, value, "", 1.0, at_most=False, level=level, **words)


def no(gate: str, code: str, value: str, level: Level, **words: str) -> Gate:
    """A row that must be false."""
    return Gate(gate, code, value, "", 0.0, at_most=True, level=level, **words)


# -- Rows about the data ---------------------------------------------------------------------------
#
# Rows about the data: the stream, what it rests on, the motion, the field.


_MOVE = CIRCLES
_TILT = "{e.motion.more_tilt}"
_NO_TILT = "tilt is not known: {e.motion.turn}"

STREAM = (
    most(
        "stream_health.errors",
        "G0",
        "health.crc_error_rate",
        "",
        "max_error_rate",
        Level.CANDIDATE,
        meaning="share of messages with a wrong checksum",
        advice="{v:.2g} of the messages are damaged (limit {l:.2g}): check cable and baud rate",
    ),
    most(
        "stream_health.drops",
        "G0",
        "health.drop_rate",
        "",
        "max_drop_rate",
        Level.CANDIDATE,
        meaning="share of samples that are missing",
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
        advice="saturated or unusable samples: {v:.0f}; look for a magnet, or move slower",
    ),
    most(
        "stream_health.time",
        "G0",
        "health.negative_dt",
        "",
        0.0,
        Level.CANDIDATE,
        meaning="times at which the device's clock went backwards, except by a reset that a "
        "program on a share requested",
        advice="the device's clock went back ({v:.0f} x): it was reset; check its supply, then "
        "restart ahrsd",
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
        advice="a compensation register was changed during this run: start again, and let no other "
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
        meaning="there was motion (3D, planar or between), and gravity is measured",
        advice=f"motion: {{e.motion.regime}}; {_MOVE} ({{e.motion.turn}})",
    ),
    least(
        "motion.heading",
        "G2",
        "motion.heading_deg",
        "deg",
        "min_heading_excursion_deg",
        Level.CANDIDATE,
        meaning="headings covered, in sectors of 10 deg",
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
        advice="the estimate has not converged: {e.would_tell}",
    ),
    least(
        "observability.score",
        "G3",
        "estimate.score",
        "",
        "min_observability",
        Level.CANDIDATE,
        meaning="weakest direction of the information, 1 = just enough",
        advice=f"the motion does not determine everything ({{v:.2g}} of {{l:.2g}}): {_TILT}",
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
        advice="the heading is not known well enough (limit {l:.1f} deg): {e.would_tell}",
        missing="the estimator has no answer yet",
    ),
    most(
        "observability.held",
        "G3",
        "change.moved_unseen_gauss",
        "gauss",
        "max_moved_unseen_gauss",
        Level.CANDIDATE,
        meaning="change of the vertical hard iron although the motion was too flat to determine it",
        advice=f"the vertical hard iron moved by {{v:.3f}} gauss on flat motion: {_TILT}",
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
        meaning="the same, for a save to flash",
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
        f"location; go away from steel; {_TILT}",
        missing="the dip is not known: drive some time without hard manoeuvres",
        applies="position_known",
    ),
    most(
        "field.place",
        "G4",
        "estimate.place_deg",
        "deg",
        "max_place_deg",
        Level.FLASH,
        meaning="heading error (1 sigma) by a field that differs from place to place, and by all "
        "else that the model does not explain",
        advice="what the model does not explain may cause {v:.2f} deg of heading error (limit "
        "{l:.2f}): the field differs from place to place, or the iron changes, and what is equal "
        "on all headings is taken for iron; repeat it in the open; run `ahrsd diagnose` on the "
        "recording to find the cause",
        missing="gravity is needed to know the heading",
    ),
)


# -- Rows about the result -------------------------------------------------------------------------
#
# Rows about the result: its proof, what it changes, whether the world stood still.


_HELD = "keep turning: held-out data must show full circles too"
_PERSON = 'a person must approve that: write_back.approval = "operator"'
_REST = "stand still for 5 s with the motors idle"

PROOF = (
    least(
        "heldout_heading.windows",
        "G5",
        "proof.windows",
        "",
        "holdout_segments",
        Level.RAM,
        meaning="held-out segments that turned by 60 deg and more",
        advice=f"{{v:.0f}} of {{l:.0f}} held-out segments are usable: {_HELD}",
    ),
    least(
        "heldout_heading.coverage",
        "G5",
        "proof_coverage_deg",
        "deg",
        "min_holdout_excursion_deg",
        Level.RAM,
        meaning="headings covered in the held-out segments",
        advice=f"held-out data show {{v:.0f}} of {{l:.0f}} deg of heading: {_HELD}",
    ),
    most(
        "heldout_heading.rms",
        "G5",
        "proof.rms_after_deg",
        "deg",
        "holdout_rms_deg",
        Level.RAM,
        meaning="magnetic against gyro heading on held-out data, rms",
        advice="heading is off by {v:.1f} deg rms on data not used (limit {l:.1f}): something "
        "magnetic moves or switches; keep it still and turn again",
        missing=_HELD,
    ),
    most(
        "heldout_heading.max",
        "G5",
        "proof.max_after_deg",
        "deg",
        "holdout_max_deg",
        Level.RAM,
        meaning="the same, largest second",
        advice="heading is off by up to {v:.1f} deg on data not used (limit {l:.1f}): a magnet "
        "or steel came near; turn again elsewhere",
        missing=_HELD,
    ),
    most(
        "heldout_heading.closure",
        "G5",
        "proof.closure_deg",
        "deg",
        "closure_deg",
        Level.RAM,
        meaning="change of the heading error over a full turn",
        advice="the heading error changes by {v:.1f} deg over a full turn (limit {l:.1f}): turn "
        "slowly, and let the sensor warm up",
        missing=f"no full turn was held out: {_HELD}",
    ),
    least(
        "better.percent",
        "G6",
        "gain_percent",
        "%",
        "min_improvement_percent",
        Level.RAM,
        meaning="reduction of the held-out rms against the calibration in force",
        advice=(
            "the held-out error falls by {v:.0f} % (needed {l:.0f}): keep the registers as they are"
        ),
        missing=_HELD,
    ),
    least(
        "better.degrees",
        "G6",
        "gain_deg",
        "deg",
        "min_improvement_deg",
        Level.RAM,
        meaning="the same in degrees",
        advice="the held-out error falls by {v:.2f} deg (needed {l:.2f}): keep the registers",
        missing=_HELD,
    ),
    least(
        "better.certain",
        "G6",
        "proof.gain_lower_deg",
        "deg",
        "min_improvement_lower_deg",
        Level.RAM,
        meaning="lower end of the 95 % interval of that improvement",
        advice="the improvement is not certain (lower bound {v:.2f} deg): keep turning",
        missing=_HELD,
    ),
    most(
        "repeatable.hard_iron",
        "G7",
        "refits.hard_iron_gauss",
        "gauss",
        "repeat_hard_iron_gauss",
        Level.RAM,
        meaning="level hard iron of the earlier half of the data against the later half",
        advice="two halves of the data differ by {v:.3f} gauss (limit {l:.3f}): the vehicle's "
        "iron changed, or one half lacks a circle; drive two more circles",
        missing="each half of the data needs motion of its own: drive two more circles",
    ),
    most(
        "repeatable.heading",
        "G7",
        "refits.halves_deg",
        "deg",
        "repeat_heading_deg",
        Level.RAM,
        meaning=(
            "heading by the earlier half of the data against the later one, worst heading and tilt"
        ),
        advice="two halves of the data differ by {v:.1f} deg (limit {l:.1f}): the vehicle's "
        "iron changed, or one half lacks a circle; drive two more circles",
        missing="each half of the data needs motion of its own: drive two more circles",
    ),
    most(
        "second_opinion.heading",
        "G8",
        "refits.second_opinion_deg",
        "deg",
        "second_opinion_deg",
        Level.RAM,
        meaning="heading by an independent fit without gyro, worst heading and tilt",
        advice=f"a fit without the gyro differs by {{v:.1f}} deg (limit {{l:.1f}}): {_MOVE}; "
        f"{_TILT}",
        missing="too little of the ellipsoid was shown for a fit without the gyro: "
        f"{_MOVE}; {_TILT}",
    ),
)

CHANGE = (
    least(
        "bounds.positive",
        "G9",
        "change.eigenvalue_min",
        "",
        "min_eigenvalue",
        Level.CANDIDATE,
        meaning="smallest eigenvalue of the symmetric part of C",
        advice="the matrix is not a calibration (eigenvalue {v:.2g}): start again",
    ),
    least(
        "bounds.diagonal_min",
        "G9",
        "change.diagonal_min",
        "",
        "min_diagonal",
        Level.CANDIDATE,
        meaning="smallest diagonal element of C",
        advice="the matrix has a diagonal of {v:.2f} (at least {l:.2f}): start again",
    ),
    most(
        "bounds.diagonal_max",
        "G9",
        "change.diagonal_max",
        "",
        "max_diagonal",
        Level.CANDIDATE,
        meaning="largest diagonal element of C",
        advice="the matrix has a diagonal of {v:.2f} (at most {l:.2f}): start again",
    ),
    most(
        "bounds.condition",
        "G9",
        "change.condition",
        "",
        "max_condition_operator",
        Level.CANDIDATE,
        meaning="condition number of C",
        advice="the soft iron is {v:.1f} to 1 (limit {l:.0f}): move the sensor away from steel",
    ),
    most(
        "bounds.condition_auto",
        "G9",
        "change.condition",
        "",
        "max_condition_auto",
        Level.UNATTENDED,
        meaning="the same, without a person",
        advice=f"the soft iron is {{v:.1f}} to 1 (limit {{l:.0f}}): {_PERSON}",
    ),
    most(
        "bounds.offset",
        "G9",
        "change.offset_gauss",
        "gauss",
        "max_offset_operator_gauss",
        Level.CANDIDATE,
        meaning="hard iron",
        advice="the hard iron is {v:.2f} gauss (limit {l:.2f}): move the sensor or the magnet",
    ),
    most(
        "bounds.offset_auto",
        "G9",
        "change.offset_gauss",
        "gauss",
        "max_offset_auto_gauss",
        Level.UNATTENDED,
        meaning="the same, without a person",
        advice=f"the hard iron is {{v:.2f}} gauss (limit {{l:.2f}}): {_PERSON}",
    ),
    most(
        "bounds.scale",
        "G9",
        "scale_change_percent",
        "%",
        "max_scale_change_percent",
        Level.CANDIDATE,
        meaning="change of scale where no position is known: the motion does not determine it",
        advice="the scale changed by {v:.1f} % without evidence (limit {l:.1f}): set the "
        "location in the configuration",
    ),
    most(
        "step.operator",
        "G10",
        "change.step_deg",
        "deg",
        "max_step_operator_deg",
        Level.CANDIDATE,
        meaning="worst heading change against an earlier calibration",
        advice="heading would change by {v:.0f} deg (limit {l:.0f}): something else is wrong; "
        "look for what moved on the vehicle",
        missing="the heading change is not known yet: field and tilt are not measured",
        applies="user_calibrated",
    ),
    most(
        "step.auto",
        "G10",
        "change.step_deg",
        "deg",
        "max_step_auto_deg",
        Level.UNATTENDED,
        meaning="the same, without a person (and for a first calibration)",
        advice=f"heading would change by {{v:.1f}} deg (limit {{l:.0f}}): {_PERSON}",
        missing="the heading change is not known yet: field and tilt are not measured",
    ),
)

STEADY = (
    no(
        "stationarity.step",
        "G11",
        "basis.stepped",
        Level.CANDIDATE,
        meaning="hard iron or gyro bias stepped, and the estimate rests on data from before that",
        advice="the iron changed on the vehicle: find what was mounted, moved or removed, fix it "
        "for good, then drive two full circles",
    ),
    most(
        "stationarity.field",
        "G11",
        "field.wander_gauss",
        "gauss",
        "max_field_change_gauss",
        Level.RAM,
        meaning="corrected field of a segment against the median segment",
        advice="the field changed by {v:.3f} gauss while the data were taken (limit {l:.3f}): "
        "switch nothing, carry nothing past the sensor, and stay in one place",
        missing="no segment is complete yet",
    ),
    most(
        "stationarity.inclination",
        "G11",
        "field.inclination_wander_deg",
        "deg",
        "max_inclination_change_deg",
        Level.RAM,
        meaning="dip of a calm segment against the median segment",
        advice="the dip changed by {v:.1f} deg while the data were taken (limit {l:.1f}): drive "
        "more gently, away from steel",
        missing="the dip is not known: drive some time without hard manoeuvres",
    ),
    most(
        "stationarity.temperature",
        "G11",
        "field.temperature_range_c",
        "degC",
        "max_temperature_drift_c",
        Level.RAM,
        meaning="range of the sensor's temperature",
        advice="the temperature moved by {v:.1f} degC (limit {l:.1f}): let the sensor warm up "
        "and start again",
        missing="no segment is complete yet, or the stream has no temperature (VNIMU and binary "
        "Temp have it)",
    ),
    most(
        "gyro_bias.size",
        "G12",
        "gyro_bias_deg_s",
        "deg/s",
        "max_gyro_bias_deg_s",
        Level.CANDIDATE,
        meaning="gyro bias",
        advice="a gyro bias of {v:.1f} deg/s (limit {l:.0f}) is no bias: the device is faulty",
        missing="the estimator has no answer yet",
    ),
    least(
        "gyro_bias.rest",
        "G12",
        "gyro.rest_s",
        "s",
        "min_rest_s",
        Level.RAM,
        meaning="rest within the last quarter of an hour",
        advice=f"{{v:.0f}} s of rest were seen (needed {{l:.0f}}): {_REST}",
    ),
    most(
        "gyro_bias.sigma",
        "G12",
        "gyro.sigma_share",
        "",
        "max_gyro_sigma_share",
        Level.RAM,
        meaning="sigma of the mean rate at rest over the change that is written",
        advice=f"rest is too short or too shaky ({{v:.2f}}, limit {{l:.2f}}): {_REST}",
        missing=_REST,
    ),
    most(
        "gyro_bias.agreement",
        "G12",
        "gyro.disagreement",
        "sigma",
        "max_gyro_disagreement",
        Level.RAM,
        meaning="gyro bias of the estimate against the mean rate at rest",
        advice=f"the gyro bias is {{v:.1f}} sigma off what rest shows (limit {{l:.0f}}): {_REST}",
        missing=_REST,
    ),
    most(
        "gyro_bias.apart",
        "G12",
        "gyro.apart_mrad_s",
        "mrad/s",
        "max_gyro_apart_mrad_s",
        Level.RAM,
        meaning="the same as a rate",
        advice="the gyro bias is {v:.1f} mrad/s off what rest shows (limit {l:.1f}), and known to "
        "+-{e.gyro.sigma_mrad_s:.1f}: turn about other axes as well, slowly and both ways",
        missing=_REST,
    ),
    most(
        "evidence.complete",
        "all",
        "unmeasured_count",
        "",
        0.0,
        Level.RAM,
        meaning="numbers of the evidence that could not be measured",
        advice="not measured yet: {e.unmeasured_names}",
    ),
)


GATES: tuple[Gate, ...] = STREAM + MOTION + FIELD + PROOF + CHANGE + STEADY


# -- Judging ---------------------------------------------------------------------------------------


_ROUNDING = 1e-6  # of the limit: 10 Hz that is summed up to 9.9999999 is 10 Hz


def judge(
    evidence: Evidence,
    limits: GateLimits,
    at_s: float,
    previous: tuple[GateResult, ...] = (),
) -> tuple[GateResult, ...]:
    """Every row that applies, in the order of the table; `since_s`: when its `ok` last changed."""
    before = {result.gate: result for result in previous}
    return tuple(
        _result(gate, evidence, limits, at_s, before.get(gate.gate))
        for gate in GATES
        if not gate.applies or attrgetter(gate.applies)(evidence)
    )


def for_level(results: Iterable[GateResult], level: Level) -> tuple[GateResult, ...]:
    """The results that guard `level` and what is below it.

    UNATTENDED adds its rows to those of RAM; what it adds for flash is the operator's policy.
    """
    guards = {gate.gate: gate.level for gate in GATES}
    wanted = _levels(level)
    return tuple(r for r in results if guards.get(r.gate, Level.CANDIDATE) in wanted)


_UNATTENDED = frozenset(gate.gate for gate in GATES if gate.level is Level.UNATTENDED)


def guards_a_write(gate: str) -> bool:
    """Whether it guards what a person approves: the write or its save.

    These are the gates that are counted, wherever a number of gates is told. The others guard only
    a write that nobody approves.
    """
    return gate not in _UNATTENDED


def holds(results: Iterable[GateResult], level: Level) -> bool:
    """Whether every row that guards `level` is there and ok."""
    chosen = {r.gate: r.ok for r in for_level(results, level)}
    needed = {g.gate for g in GATES if g.level in _levels(level) and not g.applies}
    return needed <= chosen.keys() and all(chosen.values())


def limit_of(gate: Gate, limits: GateLimits) -> float:
    """The number a row is compared with."""
    return float(getattr(limits, gate.limit)) if isinstance(gate.limit, str) else gate.limit


def _levels(level: Level) -> set[Level]:
    if level is Level.UNATTENDED:
        return {Level.CANDIDATE, Level.RAM, Level.UNATTENDED}
    return {other for other in Level if other <= level}


def _result(
    gate: Gate,
    evidence: Evidence,
    limits: GateLimits,
    at_s: float,
    before: GateResult | None,
) -> GateResult:
    value, limit = float(attrgetter(gate.value)(evidence)), limit_of(gate, limits)
    measured = math.isfinite(value)
    slack = _ROUNDING * abs(limit)
    ok = measured and (value <= limit + slack if gate.at_most else value >= limit - slack)
    words = (gate.advice if measured else gate.missing).format(v=value, l=limit, e=evidence)
    return GateResult(
        gate=gate.gate,
        value=value,
        limit=limit,
        ok=ok,
        since_s=before.since_s if before is not None and before.ok == ok else at_s,
        unit=gate.unit,
        advice="" if ok else words,
    )
