"""The MAGYC estimator: hard iron, soft iron and gyro bias from magnetometer and angular rate alone.

In order of dependence: `epoch_data` makes epochs of samples and prepares them; `chain` is the
mathematics of one epoch (pure numpy); `graph` joins epochs on GTSAM; `epoch` is one of them in the
`window`; `noise` estimates their weights; `online` turns a stream of samples into estimates and
computes their accuracy. `model_checks` tests for contradictions to the model, and for residuals
that follow attitude, rate or time (`locked`). Independently of the estimate, `step_detector` looks
for steps of iron and bias. `epoch_factor` is for other programs' graphs. Theory:
docs/design/estimator.md.
"""
