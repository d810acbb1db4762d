"""Conventions of the whole package: frames, units, signs, names.

Model of the sensor (`docs/design/architecture.md`; device formula: VN-100 manual, register 23)::

    reading      m = A h + b + noise          h: true field in the sensor frame
    correction   h = C (m - b),  C = A^-1     what register 23 applies
    gyroscope    w_read = w + w_b + noise     w = w_read - w_b   (register 84 with C = I)

* A is the soft iron: symmetric positive definite, det A = 1 unless the field's magnitude is known.
* b is the hard iron in gauss. The theses this builds on write m = A (m_t + m_b): b = A m_b.
* Frames: `b` sensor axes, x forward, y right, z down; `n` north-east-down. `v_n = R_nb @ v_b`.
* Perturbations of rotations are on the right, as GTSAM's Rot3 does: R Exp(theta).
* The gyro value of sample k is the mean rate over the step that ends at sample k; the magnetometer
  value is the field at sample k, so h_k = Exp(-(w_k - w_b) dt_k) h_(k-1).
* Units are in the names and SI, except the field, which is in gauss as the device speaks it:
  `raw_b_gauss`, `gyro_b_rad_s`, `accel_b_m_s2`, `time_s`, `host_ns`.
* Arrays are float64, (N, 3) for N vectors; matrices act on columns.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("ahrsd")
except PackageNotFoundError:  # running from a checkout that was never installed
    __version__ = "0+unknown"
