"""The online step detector of the magnetometer's residual."""
