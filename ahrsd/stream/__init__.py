"""Messages to samples: assembly, device time, rate, and undoing the device's own compensation."""
