"""Where a recording and its simulation differ, and which physics was left out.

`track` and `values` hold what travels; `hygiene` looks at the recording itself; `innovation`
filters it (`blocks`, `gains`), `null` fits the calibration (`prior`, `noise_fit`, `coarse`),
`noise` and `omnibus` judge what is left; `effects/` is the library, one table row per effect;
`gram` keeps a recording's statistics; `locate`, `name`, `engine` answer from them.
"""
