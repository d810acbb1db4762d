"""Real recordings: what every method is worth where something can be known.

    python tests/benchmarks/estimator/bench_real.py
        [--json FILE] [--short] [--only NAME ...]

drive:   circles_2022_rahul calibrates, drive_2022_rahul judges: heading against GPS course above
         4 m/s, one constant removed, and dead reckoning by the receiver's speed
optical: broad/01, 02 and 21, each calibrated by itself and by each other, against optical attitude,
         the magnetometer's lag of 11.5 ms taken out; "oracle" is the linear calibration with the
         least heading error there, fitted with the optical attitude on the very recording
punch:   one sensor on two people's fists: the hard iron must repeat
rest:    nothing is observable: no answer is the right one
honest:  errors over what was announced: RMS heading error against GPS course or optical attitude
         beyond that of the oracle, over the expected worst, the lag that was found taken out, and
         how the optical markers are mounted on the sensor, by the gyro alone; and hard irons of the
         two halves of a recording, in their sigmas

It reads the recordings beside the project and prints tables; the right answer is in no file.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ahrsd.baselines import METHODS
from ahrsd.baselines.registry import ComparisonRow
from ahrsd.calibration import Affine, Estimate
from ahrsd.config.config import Config
from ahrsd.config.sections import LocationSection
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.evaluation import Evaluation, EvaluationTrack, StoredCalibration, judge
from ahrsd.evaluation.heading import (
    QUATERNION,
    HeadingReference,
    course_reference,
    optical_reference,
)
from ahrsd.heading import wrapped
from ahrsd.offline.calibrate import calibrate
from ahrsd.offline.compare_methods import method_row, our_row, run_published
from ahrsd.offline.evaluate import find_gps_file, read_fixes, read_track
from ahrsd.report.summary import BatchResult
from ahrsd.samples import Array, SampleBlock

RECORDINGS = Path(__file__).parents[4] / "shared" / "recordings"
# Boston, where the car drove. The day is not known: a year moves |H| there by 1 mG.
BOSTON = Config(
    location=LocationSection(latitude_deg=42.34, longitude_deg=-71.09, date=date(2022, 10, 15))
)
QUICK = ("magical-ls", "magyc-bfg", "ellipsoid", "fnp")
LEAST_SPEED_M_S = 4.0
REMOUNTED_S, LARGEST_TURN_RAD = 0.1, 0.3  # steps in which rates are compared, and by how far
ORACLE_EVERY = 10  # samples at 286 Hz
BROAD_LAG_S = 0.0115  # the magnetometer trails the gyro by this in every trial
BROAD = ("01_undisturbed_slow_rotation_A", "02_undisturbed_slow_rotation_B",
         "21_undisturbed_fast_combined")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Judged:
    """A method judged on a recording. Without an answer the figures are None."""

    method: str
    made_from: str
    judged_on: str
    converged: bool
    reason: str
    before_deg: float | None = None
    after_deg: float | None = None
    worst_deg: float | None = None
    fold_spread_deg: float | None = None
    reckoning_before_percent: float | None = None
    reckoning_after_percent: float | None = None
    spread_before: float | None = None
    spread_after: float | None = None


def rows_of(
    path: Path, methods: tuple[str, ...], config: Config
) -> tuple[list[ComparisonRow], BatchResult]:
    """Ours and these methods on a recording."""
    result = calibrate(path, config)
    theirs = [method_row(result, run_published(result, name), held_out=False) for name in methods]
    return [our_row(result, held_out=False), *theirs], result


def stored(row: ComparisonRow, recording: str) -> StoredCalibration | None:
    """A row as a calibration; None where it has no answer."""
    if row.hard_iron_gauss is None:
        return None
    C = np.eye(3) if row.soft_iron is None else np.linalg.inv(row.soft_iron)
    correction = Affine(C, row.hard_iron_gauss)
    return StoredCalibration("", row.method, recording, row.converged, correction)


def judged(row: ComparisonRow, made_from: str, judged_on: str, found: Evaluation | None) -> Judged:
    """The figures of an evaluation in one line."""
    base = (row.method, made_from, judged_on, row.converged, row.reason)
    if found is None or not found.headings:
        return Judged(*base)
    pair = found.headings[0].figures
    reckoned = found.reckoned
    return Judged(
        *base,
        pair.before.rms_deg,
        pair.after.rms_deg,
        pair.after.worst_deg,
        pair.after.fold_spread_deg,
        None if reckoned is None else reckoned.figures.before.rms_percent,
        None if reckoned is None else reckoned.figures.after.rms_percent,
        found.field.before.spread,
        found.field.after.spread,
    )


def drive(folder: Path, methods: tuple[str, ...] = tuple(METHODS)) -> list[Judged]:
    """Calibrated on the circles, judged on the drive."""
    circles = folder / "vn100" / "circles_2022_rahul.csv.gz"
    path = folder / "vn100" / "drive_2022_rahul.csv.gz"
    rows, _ = rows_of(circles, methods, BOSTON)
    track, _ = read_track(path, Config())
    gps = find_gps_file(path)
    assert gps is not None
    fixes, _ = read_fixes(gps)
    references = [course_reference(fixes, LEAST_SPEED_M_S)]
    lines = []
    for row in rows:
        calibration = stored(row, circles.name)
        found = calibration and judge(path.name, track, calibration, references, fixes=fixes)
        lines.append(judged(row, circles.name, path.name, found))
    return lines


def against_optics(
    folder: Path,
    methods: tuple[str, ...] = ("ellipsoid", "magyc-bfg"),
    names: tuple[str, ...] = BROAD,
) -> list[Judged]:
    """Each trial calibrates, all of them judge."""
    paths = [folder / "broad" / f"{name}.csv.gz" for name in names]
    tracks = [without_lag(read_track(path, Config())[0], BROAD_LAG_S) for path in paths]
    lines = []
    for path, track in zip(paths, tracks, strict=True):
        reference = optical_reference(track)
        assert reference is not None
        row = oracle(track)
        found = judge(path.name, track, stored(row, path.name), [reference])  # type: ignore[arg-type]
        lines.append(judged(row, path.name[:2], path.name[:2], found))
    for path in paths:
        rows, _ = rows_of(path, methods, Config())
        for row in rows:
            calibration = stored(row, path.name)
            for other, track in zip(paths, tracks, strict=True):
                reference = optical_reference(track)
                assert reference is not None
                found = calibration and judge(other.name, track, calibration, [reference])
                lines.append(judged(row, path.name[:2], other.name[:2], found))
    return lines


def without_lag(track: EvaluationTrack, lag_s: float) -> EvaluationTrack:
    """The same with each reading of the field as it was at its own instant."""
    steps = round(lag_s / float(np.median(np.diff(track.time_s))))
    kept = len(track) - steps
    raw = track.raw_b_gauss[steps:]
    return EvaluationTrack(
        track.time_s[:kept],
        raw,
        raw,
        track.gyro_b_rad_s[:kept],
        track.accel_b_m_s2[:kept],
        covariates={name: values[:kept] for name, values in track.covariates.items()},
    )


def remounted(track: EvaluationTrack) -> EvaluationTrack:
    """The same with the optical attitude in the axes of the gyro, by the rates of both.

    Markers that are turned against the sensor are no error of its calibration.
    """
    q = np.column_stack([track.covariates[name] for name in QUATERNION])
    step = max(1, round(REMOUNTED_S / float(np.median(np.diff(track.time_s)))))
    first = np.arange(0, len(track) - step, step)
    first = first[np.isfinite(q[first]).all(axis=1) & np.isfinite(q[first + step]).all(axis=1)]
    begin, end = (Rotation.from_quat(q[k], scalar_first=True) for k in (first, first + step))
    turned = (begin.inv() * end).as_rotvec()
    angle = np.cumsum(track.gyro_b_rad_s * np.gradient(track.time_s)[:, None], axis=0)
    read = angle[first + step] - angle[first]
    small = np.linalg.norm(turned, axis=1) < LARGEST_TURN_RAD
    moved = turned[small] - turned[small].mean(axis=0), read[small] - read[small].mean(axis=0)
    mounting = Rotation.align_vectors(*moved)[0]  # from the gyro's axes to the markers'
    known = np.isfinite(q).all(axis=1)
    q[known] = (Rotation.from_quat(q[known], scalar_first=True) * mounting).as_quat(
        scalar_first=True
    )
    covariates = {**track.covariates, **dict(zip(QUATERNION, q.T, strict=True))}
    return replace(track, covariates=covariates)


def oracle(track: EvaluationTrack) -> ComparisonRow:
    """C and b with the least RMS of heading error that any linear calibration has here.

    Start: C m - c = R_wb^T H is linear in C, c and H together up to scale, the least singular
    vector. Then the azimuth of R_wb (C m - c) itself is made as constant as it can be.
    """
    q = np.column_stack([track.covariates[name] for name in QUATERNION])
    known = np.flatnonzero(np.isfinite(q).all(axis=1))[::ORACLE_EVERY]
    R_wb = Rotation.from_quat(q[known], scalar_first=True).as_matrix()
    up_w = np.mean(np.einsum("kij,kj->ki", R_wb, track.accel_b_m_s2[known]), axis=0)
    m = track.raw_b_gauss[known]
    rows = np.zeros((len(m), 3, 15))
    for i in range(3):
        rows[:, i, 3 * i : 3 * i + 3] = m
        rows[:, i, 9 + i] = -1.0
    rows[:, :, 12:] = -np.swapaxes(R_wb, 1, 2)
    flat = rows.reshape(-1, 15)
    least = np.linalg.eigh(flat.T @ flat)[1][:, 0]
    least *= np.sign(np.linalg.det(least[:9].reshape(3, 3)))
    level = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up_w])[0].as_matrix() @ R_wb

    def error_rad(x: Array) -> Array:
        h = np.einsum("kij,kj->ki", level, m @ x[:9].reshape(3, 3).T - x[9:12])
        azimuth = np.arctan2(h[:, 1], h[:, 0])
        return wrapped(azimuth - np.angle(np.mean(np.exp(1j * azimuth))))

    found = least_squares(error_rad, least[:12]).x
    C, c = found[:9].reshape(3, 3), found[9:12]
    A = np.linalg.inv(C / np.cbrt(np.linalg.det(C)))
    return ComparisonRow("oracle", A, np.linalg.solve(C, c), None, True, "")


def punch(folder: Path, methods: tuple[str, ...] = tuple(METHODS)) -> list[dict[str, object]]:
    """Hard iron (mG) of two people with the same sensor, and how far apart they are."""
    names = ("punch_2024_shaked", "punch_2024_satish")
    both = [rows_of(folder / "vn100" / f"{n}.csv.gz", methods, BOSTON)[0] for n in names]
    lines = []
    for one, other in zip(*both, strict=True):
        known = one.hard_iron_gauss is not None and other.hard_iron_gauss is not None
        lines.append(
            {
                "method": one.method,
                "shaked_mG": None
                if one.hard_iron_gauss is None
                else list(1e3 * one.hard_iron_gauss),
                "satish_mG": None
                if other.hard_iron_gauss is None
                else list(1e3 * other.hard_iron_gauss),
                "apart_mG": 1e3 * float(np.linalg.norm(one.hard_iron_gauss - other.hard_iron_gauss))
                if known
                else None,
                "converged": [one.converged, other.converged],
                "reasons": [one.reason, other.reason],
            }
        )
    return lines


def at_rest(folder: Path, methods: tuple[str, ...] = tuple(METHODS)) -> list[ComparisonRow]:
    """What every method says about a sensor at rest."""
    return rows_of(folder / "vn100" / "static_2025_kiran_5min.csv.gz", methods, BOSTON)[0]


@dataclass(frozen=True, slots=True)
class Announced:
    """An answer's RMS heading error on a recording beside the worst that it expects, deg.

    oracle_deg: what the best linear calibration leaves there: the room, the attitude; nan where
    there is no attitude to fit it to
    """

    made_from: str
    judged_on: str
    converged: bool
    error_deg: float
    oracle_deg: float
    expected_deg: float

    @property
    def ratio(self) -> float:
        """Of the error that the calibration adds over the expected worst."""
        floor = 0.0 if np.isnan(self.oracle_deg) else self.oracle_deg
        return float(np.sqrt(max(self.error_deg**2 - floor**2, 0.0))) / self.expected_deg


@dataclass(frozen=True, slots=True)
class Halves:
    """Hard irons of the two halves: largest difference in sigmas of both, and in mG."""

    name: str
    converged: tuple[bool, bool]
    sigmas: float
    apart_mg: float


def estimated(track: EvaluationTrack) -> Estimate | None:
    """Of the estimator over a track, cut where rows are missing."""
    estimator = Estimator(at_once=WHOLE)
    t = track.time_s
    steps = np.diff(t)
    cuts = np.flatnonzero((steps > 1.5 * np.median(steps)) | (steps <= 0)) + 1
    for rows in np.split(np.arange(len(t)), cuts):
        if len(rows) > 1:
            own = t[rows]
            estimator.add(
                SampleBlock(
                    own, np.r_[np.nan, np.diff(own)], own, track.raw_b_gauss[rows],
                    track.gyro_b_rad_s[rows], track.accel_b_m_s2[rows], gap_before=True,
                )
            )  # fmt: skip
    return estimator.finish()


def part(track: EvaluationTrack, rows: slice) -> EvaluationTrack:
    """These rows."""
    raw = track.raw_b_gauss[rows]
    return EvaluationTrack(
        track.time_s[rows], raw, raw, track.gyro_b_rad_s[rows], track.accel_b_m_s2[rows],
        covariates={name: values[rows] for name, values in track.covariates.items()},
    )  # fmt: skip


def honest(folder: Path) -> tuple[list[Announced], list[Halves]]:
    """Errors over what was announced, and two halves of each recording."""
    vn100, broad = folder / "vn100", [folder / "broad" / f"{n}.csv.gz" for n in BROAD]
    drive_path, circles = vn100 / "drive_2022_rahul.csv.gz", vn100 / "circles_2022_rahul.csv.gz"
    stick = folder / "repoimu" / "TStick_Test11_Trial1.csv.gz"
    punches = [vn100 / f"punch_2024_{name}.csv.gz" for name in ("shaked", "satish")]
    tracks = {
        path: read_track(path, Config())[0]
        for path in (circles, drive_path, *broad, stick, *punches)
    }
    gps = find_gps_file(drive_path)
    assert gps is not None
    answers = {path: estimated(track) for path, track in tracks.items()}
    references = {drive_path: [course_reference(read_fixes(gps)[0], LEAST_SPEED_M_S)]}
    shown, floors = dict(tracks), {drive_path: np.nan}
    for path in (*broad, stick):
        own = answers[path]
        assert own is not None
        shown[path] = remounted(without_lag(tracks[path], max(own.mag_lag_s, 0.0)))
        reference = optical_reference(shown[path])
        assert reference is not None
        references[path] = [reference]
        best = stored(oracle(shown[path]), path.name)
        assert best is not None
        floors[path] = _left_deg(path, shown[path], best, references[path])
    pairs = [(circles, drive_path), (drive_path, drive_path), (stick, stick)]
    pairs += [(one, other) for one in broad for other in broad]
    announced = []
    for made, on in pairs:
        found = answers[made]
        if found is None:
            continue
        calibration = StoredCalibration("", "magyc", made.name, found.converged, found.correction)
        left = _left_deg(on, shown[on], calibration, references[on])
        announced.append(
            Announced(
                made.stem, on.stem, found.converged, left, floors[on], found.heading_sigma_deg
            )
        )
    halves = []
    for path, track in tracks.items():
        middle = len(track) // 2
        both = [estimated(part(track, rows)) for rows in (slice(middle), slice(middle, None))]
        one, other = both
        if one is None or other is None:
            continue
        difference = one.hard_iron_gauss - other.hard_iron_gauss
        sigma = np.hypot(one.sigma[6:9], other.sigma[6:9])
        halves.append(
            Halves(
                path.stem, (one.converged, other.converged),
                float(np.max(np.abs(difference) / sigma)), 1e3 * float(np.linalg.norm(difference)),
            )
        )  # fmt: skip
    return announced, halves


def _left_deg(
    path: Path,
    track: EvaluationTrack,
    calibration: StoredCalibration,
    references: list[HeadingReference],
) -> float:
    return judge(path.name, track, calibration, references).headings[0].figures.after.rms_deg


def print_honest(announced: list[Announced], halves: list[Halves]) -> None:
    """Both as tables for a document."""
    print("\n| made from | judged on | converged | error, deg | oracle | expected | ratio |")
    print("|---|---|---|---|---|---|---|")
    for a in announced:
        print(
            f"| {a.made_from.split('.')[0]} | {a.judged_on.split('.')[0]} | "
            f"{'yes' if a.converged else 'no'} | {a.error_deg:.2f} | {a.oracle_deg:.2f} | "
            f"{a.expected_deg:.2f} | {a.ratio:.2f} |"
        )
    ratios = [a.ratio for a in announced]
    print(f"median {np.median(ratios):.2f}, most {max(ratios):.2f}")
    print("\n| halves of | converged | apart, mG | in sigmas |\n|---|---|---|---|")
    for h in halves:
        said = ", ".join("yes" if c else "no" for c in h.converged)
        print(f"| {h.name.split('.')[0]} | {said} | {h.apart_mg:.1f} | {h.sigmas:.2f} |")


def print_judged(title: str, lines: list[Judged]) -> None:
    """The table of one experiment."""
    print(f"\n{title}")
    print(f"{'method':20}{'from':>5}{'on':>5}{'before':>9}{'after':>8}{'worst':>8}{'folds':>8}"
          f"{'XY before':>11}{'after':>8}{'spread':>9}{'after':>8}")  # fmt: skip
    for line in lines:
        head = f"{line.method:20}{line.made_from[:2]:>5}{line.judged_on[:2]:>5}"
        if line.after_deg is None:
            print(f"{head}  no answer: {line.reason}")
            continue
        figures = (
            (line.before_deg, 9, 1, 1), (line.after_deg, 8, 2, 1), (line.worst_deg, 8, 1, 1),
            (line.fold_spread_deg, 8, 2, 1), (line.reckoning_before_percent, 11, 1, 1),
            (line.reckoning_after_percent, 8, 2, 1), (line.spread_before, 9, 2, 100),
            (line.spread_after, 8, 2, 100),
        )  # fmt: skip
        text = "".join(
            f"{'-':>{width}}" if value is None else f"{value * scale:{width}.{digits}f}"
            for value, width, digits, scale in figures
        )
        print(f"{head}{text}  {'' if line.converged else 'not converged'}")
    print("deg; XY: RMS in % of the distance; spread: std |h| / mean |h| in %")


def print_punch(lines: list[dict[str, object]]) -> None:
    """Two hard irons and their difference."""
    print("\npunch: hard iron of one sensor on two fists, mG")
    for line in lines:
        apart = line["apart_mG"]
        one, other = (
            "no answer" if v is None else ", ".join(f"{x:+.1f}" for x in v)  # type: ignore[attr-defined]
            for v in (line["shaked_mG"], line["satish_mG"])
        )
        words = "" if all(line["converged"]) else f"  converged: {line['converged']}"  # type: ignore[arg-type]
        told = "     -" if apart is None else f"{apart:6.1f}"
        print(f"{line['method']:20}{one:>26}{other:>26}  apart {told}{words}")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--short", action="store_true", help="fewer methods")
    parser.add_argument("--only", nargs="*", default=["drive", "optical", "punch", "rest"])
    arguments = parser.parse_args()
    methods = QUICK if arguments.short else tuple(METHODS)
    body: dict[str, object] = {"schema": "ahrsd.bench_real/1"}
    logging.getLogger("ahrsd").setLevel(logging.ERROR)  # what a daemon would warn of on the way
    began = time.process_time()
    if "drive" in arguments.only:
        lines = drive(RECORDINGS, methods)
        print_judged(
            "drive: calibrated on circles (ci), judged on a drive (dr), against GPS", lines
        )
        body["drive"] = [_as_json(line) for line in lines]
    if "optical" in arguments.only:
        lines = against_optics(RECORDINGS)
        print_judged("broad: against optical attitude", lines)
        body["optical"] = [_as_json(line) for line in lines]
    if "punch" in arguments.only:
        pairs = punch(RECORDINGS, methods)
        print_punch(pairs)
        body["punch"] = pairs
    if "rest" in arguments.only:
        rows = at_rest(RECORDINGS, methods)
        print("\nat rest")
        for row in rows:
            print(f"{row.method:20}{'ANSWERED' if row.converged else 'refused'}: {row.reason}")
        body["rest"] = [{"method": r.method, "refused": not r.converged} for r in rows]
    if "honest" in arguments.only:
        announced, halves = honest(RECORDINGS)
        print_honest(announced, halves)
        body["honest"] = {
            "announced": [_as_json(line) for line in announced],
            "halves": [_as_json(line) for line in halves],
        }
    print(f"\n{time.process_time() - began:.0f} s of processor time")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(body, indent=1))


def _as_json(line: Judged | Announced | Halves) -> dict[str, object]:
    return {name: getattr(line, name) for name in line.__slots__}


if __name__ == "__main__":
    main()
