"""What the running daemon tells: JSON lines on a Unix socket, and numbers for Prometheus.

`status` turns the core into plain values, `words` and `driving` put them into words,
`protocol` holds the rules of the conversation, `feeds` is what network shares send; `server`,
`client` and `metrics` touch the world. docs/reference/socket.md is the reference.
"""
