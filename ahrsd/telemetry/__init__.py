"""What the running daemon tells: JSON lines on a Unix socket, and numbers for Prometheus.

`status` and `records` turn the core and its events into plain values, `explain` puts them into
words, `protocol` and `outbox` hold the rules of the conversation; `server`, `client` and `metrics`
touch the world. docs/reference/socket.md is the reference.
"""
