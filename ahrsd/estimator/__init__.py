"""The MAGYC estimator: hard iron, soft iron and gyro bias from magnetometer and angular rate alone.

`chain` is the mathematics of one epoch (pure numpy), `graph` joins epochs on GTSAM, `online` turns
a stream of samples into estimates, `start` finds the first linearisation point, `steps` averages
fast streams. Theory: docs/design/estimator.md.
"""
