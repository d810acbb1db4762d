"""The device's port, and the ports and addresses at which other programs find the device."""
