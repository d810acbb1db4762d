"""Where a recording and its simulation differ, and which physics was left out.

`track` and `values` hold what travels; `innovation` filters; `effects/` is the library, one table
row per effect; `gram` keeps a recording's statistics; `locate`, `name`, `repair` answer from them.
"""
