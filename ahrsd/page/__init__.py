"""`ahrsd page`: a page for the phone at the vehicle, in a process of its own.

    feed ─▶ board ─▶ app ─▶ browsers       sphere, view: what is shown, pure
    (the daemon's socket)   ▲ access       who may ask and who may approve, pure

It reads the daemon's Unix socket as `ahrsd watch` does and can do no more to the daemon than that,
save for an operator's word where it was given a token.
"""
