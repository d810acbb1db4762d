"""Kalman filter of the field, its whitened innovations, and statistics of regressions on them."""
