"""What is known of the real recordings without any diagnosis: magnets by the optical attitude, the
motor's current by the other compass and by the field's magnitude.

    python tests/benchmarks/diagnosis/bench_known_values.py

Magnets of BROAD: m = A R h + b + d while it is on + e after it was taken off, least squares over
the optical attitudes R, the seconds in which a hand moves it left out: `on` is |d|, `off` |d - e|.
The current of log171: MAG2 = B MAG + k I + c, least squares, all rows or those in flight, the
current taken from so long after a row (a logger that is late), or everything in a band of
frequencies.  On MAG itself, which no other compass tells: |C (m - k I - b)| is the same everywhere,
with a deviation by a bootstrap of stretches of ten seconds.  In flight alone, beside a slow course
of the magnitude and noise that is alike from row to row, by how late the current is logged: `gain`
is by how many variances of what is left the three coefficients lower its squares, and beside it
what they do for currents that are moved by 3 to 70 s within the flight.  None asks the gyro.  It
reads the recordings beside the project.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import butter, filtfilt
from scipy.spatial.transform import Rotation

from ahrsd.recording.table import read_table
from ahrsd.samples import Array

RECORDINGS = Path(__file__).parents[3] / ".." / "shared" / "recordings"
#: recording: seconds around the moments at which the magnet is put on and taken off
MAGNETS = {
    "broad/32_disturbed_attached_magnet_1cm": ((36.0, 41.0), (92.0, 99.5)),
    "broad/34_disturbed_attached_magnet_3cm": ((43.0, 48.0), (96.0, 102.0)),
    "broad/36_disturbed_attached_magnet_5cm": ((35.5, 39.0), (93.0, 99.5)),
}
#: by which the magnetometer of BROAD is late, s
LATE_S = 0.0115
MAG, MAG2 = "arducopter/log171_MAG_10hz", "arducopter/log171_MAG2_10hz"
#: A, above which it flies
FLIES_A = 8.0
BANDS_HZ = ((0.02, 0.1), (0.1, 0.5), (0.5, 1.5))
DELAYS_S = (0.0, 0.1, 0.2, 0.3)
STRETCH_S, DRAWS, SEED = 10.0, 40, 1
#: s of the flight without take-off and landing;  half waves of the magnitude's slow course in it
FLIGHT_S, WAVES = (75.0, 222.0), 14
#: s by which the current is late in the log, and by which it is moved for comparison
LATER_S, MOVED_S = np.arange(-0.5, 1.01, 0.05), np.arange(3.0, 70.0, 0.4)


def magnet(name: str) -> str:
    """How large the steps are at which a magnet comes and goes."""
    rows = read_table(RECORDINGS / f"{name}.csv.gz").rows
    (begin, on), (off, gone) = MAGNETS[name]
    at = np.column_stack([rows.covariates[f"ref_q{axis}"] for axis in "xyzw"])
    at = np.column_stack([np.interp(rows.time_s - LATE_S, rows.time_s, one) for one in at.T])
    t = rows.time_s
    moved = ((t > begin) & (t < on)) | ((t > off) & (t < gone))
    known = np.isfinite(at).all(axis=1) & np.isfinite(rows.raw_b_gauss).all(axis=1) & ~moved
    turns = Rotation.from_quat(at[known]).as_matrix().reshape(-1, 9)
    there, after = ((t > on) & (t < off))[known], (t > gone)[known]
    X = np.column_stack([turns, np.ones(len(turns)), there, after])
    fit = np.linalg.lstsq(X, rows.raw_b_gauss[known], rcond=None)[0]
    left = np.sqrt(np.mean((rows.raw_b_gauss[known] - X @ fit) ** 2))
    on_gauss, off_gauss = np.linalg.norm(fit[10]), np.linalg.norm(fit[10] - fit[11])
    return f"on {on_gauss:.4f} G, off {off_gauss:.4f} G; {1e3 * left:.1f} mG of the room are left"


def per_ampere(k: Array) -> str:
    """Field by current, mG/A."""
    return f"({', '.join(f'{1e3 * one:.2f}' for one in k)}), {1e3 * np.linalg.norm(k):.2f} mG/A"


def of_regression(mag: Array, mag2: Array, current_a: Array, rows: Array) -> Array:
    """(3,) gauss/A on MAG2 beyond what is on MAG."""
    X = np.column_stack([mag, current_a, np.ones(len(mag))])[rows]
    return np.asarray(np.linalg.lstsq(X, mag2[rows], rcond=None)[0][3])


def by_magnitude(mag: Array, current_a: Array) -> Array:
    """(3,) gauss/A that makes the magnitude of a calibrated field the same everywhere."""

    def off(p: Array) -> Array:
        C = np.eye(3)
        C[np.triu_indices(3)] += p[:6]
        h = (mag - p[6:9] - np.outer(current_a, p[9:])) @ C.T
        return np.asarray((np.linalg.norm(h, axis=1) - 0.5) / 3e-3)

    return np.asarray(least_squares(off, np.zeros(12), loss="soft_l1").x[9:])


def of_magnitude(mag: Array, current_a: Array) -> tuple[Array, float]:
    """(3,) gauss/A by which a field's magnitude follows a current, and the gain of that.

    |m|^2 / size^2 on the ellipsoid's terms, the current along each axis and a slow course,
    reweighted where a row is far off, rows less what they have of the row before.
    """
    size = float(np.mean(np.linalg.norm(mag, axis=1)))
    u, along = mag / size, np.linspace(0.0, 1.0, len(mag))
    terms = [u[:, i] * u[:, j] for i in range(3) for j in range(i, 3)][1:]
    terms += [*u.T, *(np.cos(np.pi * k * along) for k in range(WAVES + 1))]
    X = np.column_stack([*(u * (current_a - current_a.mean())[:, None]).T, *terms])
    y, weight, alike = np.sum(u**2, axis=1), np.ones(len(mag) - 1), 0.0
    for _ in range(15):
        rows, left = X[1:] - alike * X[:-1], y[1:] - alike * y[:-1]
        root = np.sqrt(weight)
        fit = np.linalg.lstsq(rows * root[:, None], left * root, rcond=None)[0]
        off, slow = left - rows @ fit, y - X @ fit
        alike = float(slow[1:] @ slow[:-1] / (slow[:-1] @ slow[:-1]))
        weight = 1.0 / np.maximum(1.0, np.abs(off) / (1.5 * 1.4826 * np.median(np.abs(off))))
    root = np.sqrt(weight)
    without = np.linalg.lstsq(rows[:, 3:] * root[:, None], left * root, rcond=None)[0]
    more = np.sum(weight * (left - rows[:, 3:] @ without) ** 2)
    least = np.sum(weight * off**2)
    return fit[:3] * size / 2.0, float((more - least) / (least / len(off)))


def current_in_flight(t: Array, mag: Array, logged_a: Array) -> None:
    """MAG's current by its magnitude: by how late it is logged, beside currents that are moved."""
    flies = (t > FLIGHT_S[0]) & (t < FLIGHT_S[1])
    m, at_s = mag[flies], t[flies]
    found = [of_magnitude(m, np.interp(at_s + late_s, t, logged_a)) for late_s in LATER_S]
    best = int(np.argmax([gain for _, gain in found]))
    around = np.abs(LATER_S - LATER_S[best]) < 0.26
    said = ", ".join(
        f"{late_s:.2f} s {gain:.0f}"
        for late_s, (_, gain) in zip(LATER_S[around], np.array(found, dtype=object)[around])
    )
    length_s = at_s[-1] - at_s[0]
    moved = [
        of_magnitude(m, np.interp(at_s[0] + (at_s + way * s - at_s[0]) % length_s, t, logged_a))
        for s in MOVED_S
        for way in (-1.0, 1.0)
    ]
    scatter = 1e3 * np.std([k for k, _ in moved], axis=0)
    print(f"MAG by its magnitude in flight, current from {LATER_S[best]:.2f} s later: "
          f"{per_ampere(found[best][0])}, deviations of moved currents "
          f"({', '.join(f'{one:.2f}' for one in scatter)})")  # fmt: skip
    print(f"  gain by how late: {said}; of {len(moved)} currents moved in time the largest "
          f"{max(gain for _, gain in moved):.0f}")  # fmt: skip


def current() -> None:
    """The tables of the current."""
    first, second = (read_table(RECORDINGS / f"{name}.csv.gz").rows for name in (MAG, MAG2))
    t, mag, mag2 = first.time_s, first.raw_b_gauss, second.raw_b_gauss
    known = np.isfinite(mag).all(axis=1) & np.isfinite(mag2).all(axis=1)
    t, mag, mag2 = t[known], mag[known], mag2[known]
    logged_a = first.covariates["motor_current_a"][known]
    for delay_s in DELAYS_S:
        current_a = np.interp(t + delay_s, t, logged_a)
        flies = current_a > FLIES_A
        print(f"MAG2 against MAG, current from {delay_s:.1f} s later: "
              f"all {per_ampere(of_regression(mag, mag2, current_a, np.ones_like(flies)))}; "
              f"in flight {per_ampere(of_regression(mag, mag2, current_a, flies))}")  # fmt: skip
    current_a = np.interp(t + 0.2, t, logged_a)
    nyquist_hz = 0.5 / float(np.median(np.diff(t)))
    for low, high in BANDS_HZ:
        b, a = butter(2, [low / nyquist_hz, high / nyquist_hz], "band")
        parts = [filtfilt(b, a, one, axis=0) for one in (mag, mag2, current_a)]
        k = of_regression(*parts, current_a > FLIES_A)
        print(f"  in flight, from 0.2 s later, {low} to {high} Hz: {per_ampere(k)}")
    for delay_s in DELAYS_S[::2]:
        current_a = np.interp(t + delay_s, t, logged_a)
        stretch = ((t - t[0]) / STRETCH_S).astype(int)
        rng = np.random.default_rng(SEED)
        drawn = []
        for _ in range(DRAWS):
            picked = rng.integers(0, stretch[-1] + 1, stretch[-1] + 1)
            rows = np.concatenate([np.flatnonzero(stretch == one) for one in picked])
            drawn.append(by_magnitude(mag[rows], current_a[rows]))
        scatter = 1e3 * np.std(drawn, axis=0)
        print(f"MAG by its magnitude, current from {delay_s:.1f} s later: "
              f"{per_ampere(by_magnitude(mag, current_a))}, deviations "
              f"({', '.join(f'{one:.2f}' for one in scatter)}), seed {SEED}")  # fmt: skip
    current_in_flight(t, mag, logged_a)


def main() -> None:
    if not RECORDINGS.is_dir():
        sys.exit("the recordings (../shared/recordings) are not here")
    for name in MAGNETS:
        print(f"{name}: {magnet(name)}")
    current()


if __name__ == "__main__":
    main()
