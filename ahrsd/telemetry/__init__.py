"""What the running daemon tells: JSON lines on a Unix socket, and numbers for Prometheus.

`status` turns the core into plain values, `words` and `driving` put them into words,
`protocol` holds the rules of the conversation, `feeds` is what network shares send;
`unix_socket`, `metrics` and `sd_notify` touch the world, `public` is all of it behind one object.
docs/reference/socket.md is the reference.
"""
