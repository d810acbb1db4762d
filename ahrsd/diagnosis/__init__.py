"""Where a recording and its simulation differ, and which physics was left out.

`track` and `model` hold what travels, `priors` every prior, loss and threshold, `time_series`
operations on columns of samples.  `data_quality` looks at the recording itself and `columns` at
what was logged beside it; `innovation_filter` filters it, `calibration_fit` fits the calibration;
`effects` is the library, one table row per effect; `where_and_when` says what is left, where;
`answer` is the contract's form and its words, and `repaired_model` what a model is worth as a file
and forward.  `inference` answers from them: one generative model of all that may be in a recording.
`external_simulation` compares that with a simulation that a person brings.
"""
