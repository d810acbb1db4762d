"""`ahrsd page`: a page for the phone at the vehicle, in a process of its own.

    the daemon's socket ─▶ app ─▶ browsers   view: what is shown, pure
                            ▲ access         who may ask and who may approve, pure

It reads the daemon's Unix socket as `ahrsd watch` does and can do no more to the daemon than that,
save for an operator's word where it was given a token.
"""
