"""Other programs on the device's port: what they may do, who is asked next, whose answer it is.

Pure: bytes, policies and time in, answers out. The ports themselves are in `daemon.shares`.
"""
