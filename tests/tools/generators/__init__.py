"""Two generators of recordings in which a physical effect is concealed, each by another author.

They were written from the contract (units, signs, columns, identifiers) and the dossier of effects
(what each does, and its usual size) alone, by people who had seen neither an engine of `diagnose`,
nor its tests, nor `blind_trials.world`; they share no code with any of these or with each other.
`workboat`: boats, ROVs, AUVs and towed bodies. `road_and_air`: cars, robots, copters, hands.
`truths` puts what they say into the form in which answers are judged.

A generator that the engine was mended against is a training set: say which seeds were used.
"""
