"""The calibration and the noise that explain a recording best, whatever the effects."""
