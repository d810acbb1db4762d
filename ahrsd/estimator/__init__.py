"""The MAGYC estimator: hard iron, soft iron and gyro bias from magnetometer and angular rate alone.

From the samples up: `epoch_builder` makes epochs of samples, `epoch_data` prepares them, `chain` is
the mathematics of one epoch (pure numpy), `graph` joins epochs on GTSAM, `epoch` is one of them in
the `window`, where `noise` tells how much each counts, `online` turns a stream of samples into
estimates. `start` finds the first linearisation point, `model_checks` what contradicts the model,
`summary` what an answer is worth. `epoch_factor` is for graphs of others. Theory:
docs/design/estimator.md.
"""
