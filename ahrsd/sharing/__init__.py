"""Other programs on the device's port: permissions, order of commands, routing of answers.

Pure: bytes, policies and time in, answers out. The ports themselves are in `daemon.shares`.
"""
