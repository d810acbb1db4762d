"""Accuracy of a calibration on a recording, before and after, against independent references.

`track` is the recording as arrays, with the vertical; `heading` compares headings with references,
and dead reckoning with fixes; `judging` has the figures of the field and collects all of them, as
JSON and as a table. The calibration is read by `calibration_json`.

Sources: [R] 2.1-2.4 and 4.4, [L]; docs/guide/evaluate.md has the definitions.
"""

from ahrsd.calibration_json import StoredCalibration, parse_calibration, parse_calibrations
from ahrsd.evaluation.heading import Fixes, HeadingReference
from ahrsd.evaluation.judging import Evaluation, judge
from ahrsd.evaluation.track import EvaluationError, EvaluationTrack, build_track

__all__ = [
    "Evaluation",
    "EvaluationError",
    "EvaluationTrack",
    "Fixes",
    "HeadingReference",
    "StoredCalibration",
    "build_track",
    "judge",
    "parse_calibration",
    "parse_calibrations",
]
