"""The MAGYC estimator: hard iron, soft iron and gyro bias from magnetometer and angular rate alone.

From the samples up: `epoch_data` makes epochs of samples and prepares them, `chain` is the
mathematics of one epoch (pure numpy), `graph` joins epochs on GTSAM, `epoch` is one of them in the
`window`, where `noise` tells how much each counts, `online` turns a stream of samples into
estimates and says what they are worth. `model_checks` finds what contradicts the model, or is left
over by it and `locked` to attitude, rate or time; `step_detector` looks for steps of iron and bias
beside it.
`epoch_factor` is for graphs of others. Theory: docs/design/estimator.md.
"""
